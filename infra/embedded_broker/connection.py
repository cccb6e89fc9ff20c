"""One client, from its first byte to its last: what MQTT 3.1.1 says, and what its grant allows.

Decisions where the specification leaves room, all of them towards refusing:

- A publish that the grant does not cover, that is too long, or at QoS 2 ends the connection, as AWS IoT Core does.
  MQTT 3.1.1 has no way to refuse one message, and acknowledging it would be a lie.
- All sessions are clean: nothing is queued for somebody who is not there. A client that falls too far behind loses
  QoS 0 messages first and then its connection, never a QoS 1 message in silence.
- Whatever ends a connection other than DISCONNECT lets its will be said, a revocation too: an agent that was cut off
  is offline.
"""

import logging
from collections import deque
from typing import NamedTuple, Protocol

from amqtt.mqtt.packet import CONNECT, DISCONNECT, PINGREQ, PUBACK, PUBLISH, SUBSCRIBE, UNSUBSCRIBE

from device_agent.protocol.security import revocation
from device_agent.protocol.security.grants import Grant
from infra.embedded_broker import packets
from infra.embedded_broker.limits import Limits
from infra.embedded_broker.listeners import Link
from infra.embedded_broker.packets import Connect, Frame, MalformedPacket, Publish
from infra.embedded_broker.routing import valid_filter, valid_topic

log = logging.getLogger("telescope.broker")

_REMEMBERED_TOPICS = 1_024
KEEP_ALIVE_FACTOR = 1.5
"""How often the promised interval a client may be silent [MQTT-3.1.2-24]."""


class Admission(NamedTuple):
    """What an accepted CONNECT is worth; the token is kept to be judged again when the keys change."""

    grant: Grant
    token: str
    issued_at: float


class Refused(Exception):  # noqa: N818 (an answer, not a fault)
    """A CONNECT that is answered with ``code`` and the end of the connection."""

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


class Exchange(Protocol):
    """What a connection asks of the broker around it."""

    limits: Limits

    def admit(self, connect: Connect) -> Admission:
        """Judge a CONNECT; nobody else notices one that is ``Refused``."""

    def enter(self, connection: "Connection") -> None:
        """Make an admitted connection the one of its client id; whoever had it before is cut off."""

    def leave(self, connection: "Connection") -> None:
        """Forget a connection. Called once for each, admitted or not."""

    def publish(self, topic: str, payload: bytes, *, qos: int, retain: bool, owner: str) -> bool:
        """Hand a message to all who hear it, and keep it where it is retained; False where that is full."""

    def subscribe(self, connection: "Connection", pattern: str, qos: int) -> None:
        """Add a filter, and tell the connection what is retained for it."""

    def unsubscribe(self, connection: "Connection", pattern: str) -> None:
        """Take a filter back."""

    def instruct(self, payload: bytes) -> None:
        """Do what a message on ``control.TOPIC`` says.

        Raises:
            ValueError: It says nothing that can be done.
        """


class Connection:
    """The state of one client. All its methods run on the broker's loop and none of them waits."""

    def __init__(self, exchange: Exchange, link: Link, now_s: float, peer: str) -> None:
        self.admission: Admission | None = None
        self.filters: set[str] = set()
        self._exchange = exchange
        self._limits = exchange.limits
        self._link = link
        self._peer = peer
        self._framer = packets.Framer(self._limits)
        self._over = False
        self._will: packets.Will | None = None
        self._keep_alive_s = 0.0
        self._since_s = self._heard_s = now_s
        self._heard = False
        self._publishable: set[str] = set()
        self._packet_id = 0
        self._inflight: set[int] = set()
        self._waiting: deque[tuple[str, bytes, int, bool]] = deque()
        self._waiting_bytes = 0

    @property
    def client_id(self) -> str:
        """The client id, once admitted."""
        return "" if self.admission is None else self.admission.grant.client_id

    def received(self, data: bytes) -> None:
        """Bytes from the client. Whatever they are, nothing is raised."""
        self._heard = True
        try:
            for frame in self._framer.feed(data):
                if self._over:
                    return
                self._take(frame)
        except MalformedPacket as error:
            self.end(f"malformed: {error}")
        except Exception as error:  # noqa: BLE001 (a fault in serving one client must not reach the others)
            self.end(f"fault in the broker: {type(error).__name__}: {error}")

    def drained(self) -> None:
        """The link has room again."""
        self._pump()

    def lost(self) -> None:
        """The link is gone."""
        self.end("")

    def tick(self, now_s: float, wall_s: float) -> None:
        """Look at the clocks: monotonic for silence, wall clock [s since 1970] for the token."""
        if self._heard:
            self._heard = False
            self._heard_s = now_s
        if self.admission is None:
            if now_s - self._since_s > self._limits.connect_timeout_s:
                self.end("no CONNECT")
        elif wall_s >= self.admission.grant.expires_at:
            self.end("its token has run out")
        elif self._keep_alive_s and now_s - self._heard_s > self._keep_alive_s:
            self.end("no sign of life within its keep-alive")

    def deliver(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> None:
        """A message that must arrive or end the connection: QoS 1, or retained."""
        if self._over:
            return
        if not self._waiting and self._may_send(qos):
            self._send(topic, payload, qos=qos, retain=retain)
            return
        self._waiting.append((topic, payload, qos, retain))
        self._waiting_bytes += len(payload)
        if len(self._waiting) > self._limits.waiting or self._waiting_bytes > self._limits.waiting_bytes:
            self.end("it does not keep up with what it subscribed to")

    def deliver_packet(self, packet: bytes) -> None:
        """A QoS 0 PUBLISH, ready made; dropped when the client does not keep up."""
        if not self._link.congested:
            self._link.write(packet)

    def end(self, why: str, *, flush: bool = False, say_will: bool = True) -> None:
        """End the connection, and say its will. May be called at any time and more than once.

        Args:
            why: For the log; empty for what is nobody's fault.
            flush: Whether what was written is still to be sent.
            say_will: False after DISCONNECT.
        """
        if self._over:
            return
        self._over = True
        if why:
            log.warning("%s (%s): %s", self.client_id or "unknown client", self._peer, why)
        if flush:
            self._link.close()
        else:
            self._link.abort()
        self._exchange.leave(self)
        self._waiting.clear()
        if say_will and self._will is not None:
            will, self._will = self._will, None
            self._exchange.publish(will.topic, will.payload, qos=will.qos, retain=will.retain, owner=self.client_id)

    def _take(self, frame: Frame) -> None:
        if frame.kind == PUBLISH:
            self._take_publish(packets.read_publish(frame))
        elif frame.kind == PUBACK:
            self._inflight.discard(packets.read_puback(frame))
            self._pump()
        elif frame.kind == PINGREQ:
            self._reply(packets.PINGRESP)
        elif frame.kind == SUBSCRIBE:
            self._take_subscribe(*packets.read_subscribe(frame))
        elif frame.kind == UNSUBSCRIBE:
            packet_id, filters = packets.read_unsubscribe(frame)
            for pattern in filters:
                self.filters.discard(pattern)
                self._exchange.unsubscribe(self, pattern)
            self._reply(packets.unsuback(packet_id))
        elif frame.kind == DISCONNECT:
            self.end("", flush=not self._link.congested, say_will=False)
        elif frame.kind == CONNECT:
            self._take_connect(frame)

    def _take_connect(self, frame: Frame) -> None:
        claimed = ""
        try:
            connect = packets.read_connect(frame.body)
            claimed = connect.client_id[:64]
            admission = self._exchange.admit(connect)
            self._check_will(connect.will, admission.grant)
        except packets.UnacceptableProtocol:
            # Clients of MQTT 5 try 3.1.1 next: they need this answer at once, and in the form of 3.1.1.
            self._link.write(packets.connack(packets.BAD_PROTOCOL))
            self.end("", flush=True)
            return
        except Refused as refusal:
            self._link.write(packets.connack(refusal.code))
            self.end(f"CONNECT as {claimed!r} refused: {refusal}", flush=True)
            return
        self.admission = admission
        self._will = connect.will
        self._keep_alive_s = connect.keep_alive_s * KEEP_ALIVE_FACTOR
        self._framer.open_up()
        self._exchange.enter(self)
        self._link.write(packets.connack(packets.ACCEPTED))

    def _check_will(self, will: packets.Will | None, grant: Grant) -> None:
        if will is None:
            return
        if not valid_topic(will.topic, self._limits.topic_bytes) or not grant.may_publish(will.topic):
            raise Refused(packets.NOT_AUTHORISED, "its will is on a topic that it may not publish to")
        if len(will.payload) > (self._limits.retained_bytes if will.retain else self._limits.payload_bytes):
            raise Refused(packets.NOT_AUTHORISED, "its will is too long")

    def _take_publish(self, message: Publish) -> None:
        topic = message.topic
        if message.qos > packets.MAX_QOS:
            self.end(f"published at QoS {message.qos}; {packets.MAX_QOS} is the most")
        elif len(message.payload) > self._limits.payload_bytes:
            self.end(f"published {len(message.payload)} bytes; {self._limits.payload_bytes} is the most")
        elif message.retain and len(message.payload) > self._limits.retained_bytes:
            self.end(f"published {len(message.payload)} bytes retained; {self._limits.retained_bytes} is the most")
        elif topic not in self._publishable and not self._may_publish(topic):
            self.end(f"published to {topic[:200]!r}, which its token does not allow")
        elif topic == revocation.TOPIC:
            self._take_instruction(message)
        elif not self._exchange.publish(
            topic, message.payload, qos=message.qos, retain=message.retain, owner=self.client_id
        ):
            self.end(f"retained more than the broker keeps for one client, at {topic[:200]!r}")
        elif message.qos:
            self._reply(packets.puback(message.packet_id))

    def _take_instruction(self, message: Publish) -> None:
        try:
            self._exchange.instruct(message.payload)
        except ValueError as error:
            self.end(f"an instruction that cannot be followed: {error}")
            return
        if message.qos:
            self._reply(packets.puback(message.packet_id))

    def _may_publish(self, topic: str) -> bool:
        """Judge a topic by the grant; what is allowed is remembered, so that it is judged once."""
        assert self.admission is not None  # noqa: S101 (the framer lets nothing but CONNECT through before)
        if topic != revocation.TOPIC and not valid_topic(topic, self._limits.topic_bytes):
            return False
        if not self.admission.grant.may_publish(topic):
            return False
        if len(self._publishable) >= _REMEMBERED_TOPICS:
            self._publishable.clear()
        self._publishable.add(topic)
        return True

    def _take_subscribe(self, packet_id: int, filters: list[tuple[str, int]]) -> None:
        if len(filters) > self._limits.filters_per_subscribe:
            self.end(f"{len(filters)} filters in one SUBSCRIBE; {self._limits.filters_per_subscribe} is the most")
            return
        granted = [(pattern, min(qos, packets.MAX_QOS)) for pattern, qos in filters if self._may_subscribe(pattern)]
        allowed = dict(granted)
        self._reply(packets.suback(packet_id, [allowed.get(pattern, packets.REFUSED) for pattern, _ in filters]))
        for pattern, qos in granted:
            if self._over:  # the retained messages of the last one were too many for it
                return
            self._exchange.subscribe(self, pattern, qos)

    def _may_subscribe(self, pattern: str) -> bool:
        assert self.admission is not None  # noqa: S101 (as above)
        if not valid_filter(pattern, self._limits.topic_bytes) or not self.admission.grant.may_subscribe(pattern):
            return False
        if pattern not in self.filters and len(self.filters) >= self._limits.filters_per_client:
            return False
        self.filters.add(pattern)
        return True

    def _reply(self, packet: bytes) -> None:
        self._link.write(packet)
        if self._link.unsent > self._limits.unsent_bytes:
            self.end("it asks and does not read the answers")

    def _may_send(self, qos: int) -> bool:
        return not self._link.congested and (not qos or len(self._inflight) < self._limits.inflight)

    def _send(self, topic: str, payload: bytes, *, qos: int, retain: bool) -> None:
        if qos:
            while True:
                self._packet_id = self._packet_id % 0xFFFF + 1
                if self._packet_id not in self._inflight:
                    break
            self._inflight.add(self._packet_id)
            self._link.write(packets.publish(topic, payload, packet_id=self._packet_id, retain=retain))
        else:
            self._link.write(packets.publish(topic, payload, retain=retain))

    def _pump(self) -> None:
        while self._waiting and not self._over and self._may_send(self._waiting[0][2]):
            topic, payload, qos, retain = self._waiting.popleft()
            self._waiting_bytes -= len(payload)
            self._send(topic, payload, qos=qos, retain=retain)
