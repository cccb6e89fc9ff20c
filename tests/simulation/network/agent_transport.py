"""MQTT transport of a simulated agent, with the behaviour of ``device_agent.transports.mqtt``."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol import topics
from device_agent.runtime.storage.journal import JournalError
from device_agent.transports import presence
from device_agent.transports.mqtt.confirmations import Confirmations
from device_agent.transports.mqtt.transport import KEEP_ALIVE_S, SILENCE_TIMEOUT_S
from tests.simulation.network.broker import Link, Packet

if TYPE_CHECKING:
    from tests.simulation.actors.agent import AgentMachine, BrokerTicket

CONNECT_TIMEOUT_S = 5.0
POLL_S = 0.5
FIRST_RETRY_S, LAST_RETRY_S = 0.5, 5.0


class SimulatedTransport:
    """``Transport``: one connection at a time, each with new credentials, session number and will."""

    def __init__(self, machine: "AgentMachine", next_session: Callable[[], int]) -> None:
        self._machine = machine
        self._next_session = next_session
        self._threading = machine.world.modules.threading
        self._inbox: Any = machine.world.modules.queue.SimpleQueue()
        self._stopping = self._threading.Event()
        self._link: Link | None = None
        self._confirmations = Confirmations()
        self._delivered: dict[int, Callable[[], None] | None] = {}
        self._number = 0
        self._up = False
        self._session = 0
        self._traffic_s = 0.0

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        self._receive = receive
        self._link_changed = link_changed
        self._thread = self._threading.Thread(target=self._run, name="mqtt")
        self._thread.start()

    def publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> bool:
        if self._link is None or not self._up:
            return False
        number = 0
        if delivered is not None and self._confirmations.expect(topic, payload, delivered):
            delivered = None
        if qos:
            self._number += 1
            number = self._number
            self._delivered[number] = delivered
        self._link.publish(Packet(topic, payload, qos, retain, number))
        return True

    def stop(self) -> None:
        self._stopping.set()
        self._inbox.put(("closed", None))
        self._thread.join(timeout=3)

    # ------------------------------------------------------------ the transport's thread

    def _run(self) -> None:
        pause_s = FIRST_RETRY_S
        while not self._stopping.is_set():
            try:
                ticket = self._machine.request_credentials()
                if ticket is not None and self._serve(ticket):
                    pause_s = FIRST_RETRY_S
            except (OSError, JournalError):
                pass  # the real transport also tries again after any error
            if self._stopping.wait(pause_s):
                break
            pause_s = min(2 * pause_s, LAST_RETRY_S)

    def _serve(self, ticket: "BrokerTicket") -> bool:
        """Run one connection until it ends. Returns whether it was established."""
        world = self._machine.world
        self._session = self._next_session()
        self._inbox = world.modules.queue.SimpleQueue()
        will = Packet(topics.conn(ticket.space, ticket.client_id), self._presence(online=False), 1, retain=True)
        client = _Callbacks(self._inbox)
        link = self._link = world.broker.connect(
            self._machine.name, ticket.client_id, ticket.credentials, client, will=will, keep_alive_s=KEEP_ALIVE_S
        )
        self._delivered = {}
        self._confirmations.filter = ticket.confirmations
        started_s = self._traffic_s = pinged_s = world.loop.time()
        was_up = False
        try:
            while not self._stopping.is_set():
                kind, value = self._next()
                if kind == "closed":
                    break
                self._handle(link, ticket, kind, value)
                was_up = was_up or self._up
                now_s = world.loop.time()
                if now_s - (self._traffic_s if self._up else started_s) > SILENCE_TIMEOUT_S:
                    break
                if self._up and now_s - pinged_s > KEEP_ALIVE_S / 2:
                    link.ping()
                    pinged_s = now_s
            if self._stopping.is_set() and self._up:
                link.publish(Packet(will.topic, will.payload, 1, retain=True))
                link.disconnect()
        finally:
            self._up, self._link = False, None
            link.drop()
            if was_up:
                self._link_changed(False)
        return was_up

    def _next(self) -> tuple[str, Any]:
        try:
            kind, value = self._inbox.get(timeout=POLL_S)
        except self._machine.world.modules.queue.Empty:
            return "", None
        self._traffic_s = self._machine.world.loop.time()
        return kind, value

    def _handle(self, link: Link, ticket: "BrokerTicket", kind: str, value: Any) -> None:
        match kind:
            case "connected" if value:
                link.subscribe(dict.fromkeys((*ticket.subscribe, ticket.confirmations), 1))
            case "subscribed" if value:
                self._up = True
                link.publish(Packet(topics.conn(ticket.space, ticket.client_id), self._presence(online=True), 1, True))
                self._link_changed(True)
            case "connected" | "subscribed":
                self._inbox.put(("closed", None))
            case "packet":
                if not self._confirmations.receive(value.topic, value.payload):
                    self._receive(value.topic, value.payload)
                if value.qos:
                    link.acknowledge(value.number)
            case "published":
                delivered = self._delivered.pop(value, None)
                if delivered is not None:
                    delivered()

    def _presence(self, *, online: bool) -> bytes:
        return presence.encode(online=online, session=self._session, software="simulated")


class _Callbacks:
    """Puts what arrives into the inbox of the transport's thread."""

    def __init__(self, inbox: Any) -> None:
        self._inbox = inbox

    def on_connected(self, accepted: bool) -> None:
        self._inbox.put(("connected", accepted))

    def on_subscribed(self, accepted: bool) -> None:
        self._inbox.put(("subscribed", accepted))

    def on_packet(self, packet: Packet) -> None:
        self._inbox.put(("packet", packet))

    def on_published(self, number: int) -> None:
        self._inbox.put(("published", number))

    def on_traffic(self) -> None:
        self._inbox.put(("traffic", None))

    def on_closed(self) -> None:
        self._inbox.put(("closed", None))
