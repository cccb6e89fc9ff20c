"""An MQTT broker: clean sessions, QoS 0 and 1 with a window, retained messages, wills, keep-alive and grants.

It has no persistence: a crash loses retained messages and all messages in transit.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from device_agent.protocol import topics
from device_agent.protocol.security.grants import Grant
from function_app.ports.broker_access import Credentials
from tests.simulation.network.wires import BROKER, Network, Wire

WINDOW = 20
"""Messages with QoS 1 that a subscriber has not acknowledged; more wait at the broker."""
RESET_S = 0.02
"""Time until clients notice that the process of the broker has ended [s]."""


@dataclass(frozen=True, slots=True)
class Packet:
    """A PUBLISH packet; ``number`` is its packet id, 0 for QoS 0."""

    topic: str
    payload: bytes
    qos: int = 0
    retain: bool = False
    number: int = 0


class Client(Protocol):
    """Callbacks of a client, in the event loop."""

    def on_connected(self, accepted: bool) -> None: ...

    def on_subscribed(self, accepted: bool) -> None: ...

    def on_packet(self, packet: Packet) -> None: ...

    def on_published(self, number: int) -> None: ...

    def on_traffic(self) -> None: ...

    def on_closed(self) -> None: ...


class Link:
    """One connection of a client, as seen by both ends."""

    def __init__(
        self,
        broker: "Broker",
        machine: str,
        client_id: str,
        client: Client,
        *,
        will: Packet | None,
        keep_alive_s: float,
    ) -> None:
        self.client_id = client_id
        self.machine = machine
        self.client = client
        self.will = will
        self.keep_alive_s = keep_alive_s
        self.grant: Grant | None = None
        self.filters: dict[str, int] = {}
        self.inflight: dict[int, Packet] = {}
        self.waiting: deque[Packet] = deque()
        self.last_packet_s = 0.0
        self.number = 0
        self._broker = broker
        self.up = Wire(broker.network, machine, BROKER)
        self.down = Wire(broker.network, BROKER, machine)
        self.closed = False

    # ------------------------------------------------------------ the client's side

    def subscribe(self, filters: dict[str, int]) -> None:
        """Subscribe to filters with a QoS each."""
        self.up.send(lambda: self._broker.subscribe(self, filters))

    def publish(self, packet: Packet) -> None:
        self.up.send(lambda: self._broker.receive(self, packet), packet.topic)

    def acknowledge(self, number: int) -> None:
        self.up.send(lambda: self._broker.acknowledged(self, number), "ack")

    def ping(self) -> None:
        self.up.send(lambda: self._broker.ping(self), "ping")

    def disconnect(self) -> None:
        """Send DISCONNECT, so that the broker does not publish the will."""
        self.up.send(lambda: self._broker.close(self, will=False))

    def drop(self) -> None:
        """Close the socket without DISCONNECT, as the end of the process does."""
        self.down.close()
        self.up.send(lambda: self._broker.close(self))


class Broker:
    """The broker process.

    Attributes:
        running: Whether the process runs.
        grants: Token → grant; on disk.
        routed: Called with link and packet for each delivery to a client.
    """

    def __init__(self, network: Network, *, now_s: Callable[[], float]) -> None:
        self.network = network
        self.now_s = now_s
        self.running = True
        self.grants: dict[str, Grant] = {}
        self.routed: Callable[[Link, Packet], None] = lambda _link, _packet: None
        self._links: dict[str, Link] = {}
        self._open: list[Link] = []
        self._retained: dict[str, bytes] = {}
        self._matches: dict[tuple[str, str], bool] = {}

    @property
    def reachable(self) -> bool:
        """Whether the cloud can change permissions now."""
        return self.running and not self.network.is_blocked("cloud", BROKER)

    # ------------------------------------------------------------ process

    def crash(self) -> None:
        """End the process: everything except the grants is lost."""
        self.running = False
        self._retained.clear()
        self._links.clear()
        for link in self._open:
            link.closed = True
            link.up.close()
            link.down.close()
            self.network.loop.call_later(RESET_S, link.client.on_closed)
        self._open = []

    def restart(self) -> None:
        self.running = True

    def revoke(self, covered: Callable[[Grant], bool]) -> None:
        """Delete matching grants, and close their connections."""
        for token in [token for token, grant in self.grants.items() if covered(grant)]:
            del self.grants[token]
        for link in list(self._links.values()):
            if link.grant is not None and covered(link.grant):
                self.close(link)

    # ------------------------------------------------------------ connections

    def connect(
        self,
        machine: str,
        client_id: str,
        credentials: Credentials,
        client: Client,
        *,
        will: Packet | None = None,
        keep_alive_s: float = 30.0,
    ) -> Link:
        """Open a connection from a machine; the client learns the result."""
        link = Link(self, machine, client_id, client, will=will, keep_alive_s=keep_alive_s)
        self._open.append(link)
        link.up.send(lambda: self._accept(link, credentials))
        return link

    def _accept(self, link: Link, credentials: Credentials) -> None:
        if not self.running:
            link.closed = True
            link.client.on_closed()
            return
        grant = self.grants.get(credentials.password)
        valid = grant is not None and (grant.principal, grant.client_id) == (credentials.username, link.client_id)
        if grant is None or not valid or grant.expires_at <= self.now_s():
            link.down.send(lambda: link.client.on_connected(False))
            return
        earlier = self._links.get(link.client_id)
        if earlier is not None:
            self.close(earlier)
        link.grant = grant
        link.last_packet_s = self.network.loop.time()
        self._links[link.client_id] = link
        self.network.loop.call_later(1.5 * link.keep_alive_s, self._check_keep_alive, link)
        link.down.send(lambda: link.client.on_connected(True))

    def _check_keep_alive(self, link: Link) -> None:
        if link.closed:
            return
        left_s = link.last_packet_s + 1.5 * link.keep_alive_s - self.network.loop.time()
        if left_s <= 0:
            self.close(link)
        else:
            self.network.loop.call_later(left_s, self._check_keep_alive, link)

    def close(self, link: Link, *, will: bool = True) -> None:
        """Close a connection; publish its will unless the client disconnected properly."""
        if link.closed:
            return
        link.closed = True
        link.up.close()
        self._open.remove(link)
        if self._links.get(link.client_id) is link:
            del self._links[link.client_id]
            if will and link.will is not None:
                self._route(link.will)

        def closed() -> None:
            link.down.close()
            link.client.on_closed()

        link.down.send(closed)

    def reset(self, machine: str) -> None:
        """The process of a client ended: its machine resets the connections."""
        for link in [link for link in self._open if link.machine == machine]:
            link.drop()

    # ------------------------------------------------------------ packets of clients

    def ping(self, link: Link) -> None:
        link.last_packet_s = self.network.loop.time()
        link.down.send(link.client.on_traffic, "ping")

    def subscribe(self, link: Link, filters: dict[str, int]) -> None:
        link.last_packet_s = self.network.loop.time()
        accepted = link.grant is not None and all(link.grant.may_subscribe(pattern) for pattern in filters)
        link.down.send(lambda: link.client.on_subscribed(accepted))
        if not accepted:
            return
        link.filters.update(filters)
        for topic, payload in self._retained.items():
            for pattern, qos in filters.items():
                if self._is_match(pattern, topic):
                    self._send(link, Packet(topic, payload, qos, retain=True))

    def receive(self, link: Link, packet: Packet) -> None:
        link.last_packet_s = self.network.loop.time()
        if packet.qos:
            link.down.send(lambda: link.client.on_published(packet.number), "puback")
        if link.grant is not None and link.grant.expires_at > self.now_s() and link.grant.may_publish(packet.topic):
            self._route(packet)

    def acknowledged(self, link: Link, number: int) -> None:
        link.last_packet_s = self.network.loop.time()
        link.inflight.pop(number, None)
        while link.waiting and len(link.inflight) < WINDOW:
            self._transmit(link, link.waiting.popleft())

    def _route(self, packet: Packet) -> None:
        if packet.retain:
            if packet.payload:
                self._retained[packet.topic] = packet.payload
            else:
                self._retained.pop(packet.topic, None)
        for link in list(self._links.values()):
            qos = max((q for pattern, q in link.filters.items() if self._is_match(pattern, packet.topic)), default=-1)
            if qos >= 0:
                self._send(link, Packet(packet.topic, packet.payload, min(qos, packet.qos)))

    def _send(self, link: Link, packet: Packet) -> None:
        if packet.qos and len(link.inflight) >= WINDOW:
            link.waiting.append(packet)
        else:
            self._transmit(link, packet)

    def _transmit(self, link: Link, packet: Packet) -> None:
        self.routed(link, packet)
        if not packet.qos:
            link.down.send(lambda: link.client.on_packet(packet), packet.topic)
            return
        link.number += 1
        numbered = Packet(packet.topic, packet.payload, 1, packet.retain, link.number)
        link.inflight[link.number] = numbered
        for _ in range(2 if self.network.is_duplicated(link.machine) else 1):
            link.down.send(lambda: link.client.on_packet(numbered), packet.topic)

    def _is_match(self, pattern: str, topic: str) -> bool:
        key = (pattern, topic)
        found = self._matches.get(key)
        if found is None:
            found = self._matches[key] = topics.matches(pattern, topic)
        return found
