"""One client connection: MQTT 3.1.1 within the client's grant.

Where the specification leaves a choice, the broker is strict:

- A publish that the grant does not cover, that is too long, or at QoS 2 closes the connection, as in AWS IoT Core.
  MQTT 3.1.1 cannot reject a single message, and an acknowledgement would be false.
- All sessions are clean: nothing is queued for offline clients. A slow client first loses QoS 0 messages and then its
  connection, but never a QoS 1 message silently.
- Every end of a connection other than DISCONNECT publishes its will, also a revocation: the agent is then offline.
"""

import logging
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from amqtt.mqtt.packet import CONNECT, DISCONNECT, PINGREQ, PUBACK, PUBLISH, SUBSCRIBE, UNSUBSCRIBE

from device_agent.protocol import topics
from device_agent.protocol.security import revocation
from device_agent.protocol.security.grants import Grant
from infra.embedded_broker import packets
from infra.embedded_broker.listeners import Transport
from infra.embedded_broker.packets import Frame, MalformedPacket, Publish
from infra.embedded_broker.routing import valid_filter, valid_topic

if TYPE_CHECKING:
    from infra.embedded_broker.broker import TelescopeBroker

log = logging.getLogger("telescope.broker")

_CACHED_TOPICS = 1_024
KEEP_ALIVE_FACTOR = 1.5
"""Permitted silence relative to the keep-alive interval [MQTT-3.1.2-24]."""


class Admission(NamedTuple):
    """The result of an accepted CONNECT; the token is checked again when the keys change."""

    grant: Grant
    token: str
    issued_at: float


class Refused(Exception):  # noqa: N818 (a response, not an error)
    """A CONNECT that is rejected with ``code`` before the connection is closed."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code


class Connection:
    """The state of one client. All methods run on the broker's event loop and never block."""

    def __init__(self, broker: "TelescopeBroker", transport: Transport, now_s: float, peer: str) -> None:
        self.admission: Admission | None = None
        self.filters: set[str] = set()
        self._broker = broker
        self._limits = broker.limits
        self._transport = transport
        self._peer = peer
        self._framer = packets.Framer(self._limits)
        self._closed = False
        self._will: packets.Will | None = None
        self._keep_alive_s = 0.0
        self._active_s = now_s
        self._active = False
        self._publishable: set[str] = set()
        self._packet_id = 0
        self._inflight: set[int] = set()
        self._queue: deque[tuple[str, bytes, int, bool]] = deque()
        self._queue_bytes = 0

    @property
    def client_id(self) -> str:
        """The client id, once admitted."""
        return "" if self.admission is None else self.admission.grant.client_id

    def received(self, data: bytes) -> None:
        """Process bytes from the client. Never raises."""
        self._active = True
        try:
            for frame in self._framer.feed(data):
                if self._closed:
                    return
                self._handle(frame)
        except MalformedPacket as error:
            self.close(f"malformed packet: {error}")
        except Exception as error:  # noqa: BLE001 (an error of one client must not affect others)
            self.close(f"internal error: {type(error).__name__}: {error}")

    def drained(self) -> None:
        """The transport accepts data again."""
        self._send_queued()

    def lost(self) -> None:
        """The transport has closed."""
        self.close("")

    def tick(self, now_s: float, wall_s: float) -> None:
        """Check timeouts: monotonic clock for silence, wall clock [s since 1970] for the token."""
        if self._active:
            self._active = False
            self._active_s = now_s
        if self.admission is None:
            return  # the listener limits the time to CONNECT
        if wall_s >= self.admission.grant.expires_at:
            self.close("the token has expired")
        elif self._keep_alive_s and now_s - self._active_s > self._keep_alive_s:
            self.close("keep-alive timeout")

    def deliver(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> None:
        """Send a message that must not be dropped (QoS 1 or retained), or close the connection."""
        if self._closed:
            return
        if not self._queue and self._may_send(qos):
            self._send(topic, payload, qos=qos, retain=retain)
            return
        self._queue.append((topic, payload, qos, retain))
        self._queue_bytes += len(payload)
        if len(self._queue) > self._limits.queued or self._queue_bytes > self._limits.queued_bytes:
            self.close("the client is too slow for its subscriptions")

    def deliver_packet(self, packet: bytes) -> None:
        """Send an encoded QoS 0 PUBLISH; dropped if the client is too slow."""
        if not self._transport.congested:
            self._transport.write(packet)

    def close(self, reason: str, *, flush: bool = False, publish_will: bool = True) -> None:
        """Close the connection and publish its will. May be called at any time and repeatedly.

        Args:
            reason: For the log; empty for a normal end.
            flush: Whether to send pending data first.
            publish_will: False after DISCONNECT.
        """
        if self._closed:
            return
        self._closed = True
        if reason:
            log.warning("%s (%s): %s", self.client_id or "unknown client", self._peer, reason)
        if flush:
            self._transport.close()
        else:
            self._transport.abort()
        self._broker.unregister(self)
        self._queue.clear()
        if publish_will and self._will is not None:
            will, self._will = self._will, None
            self._broker.publish(will.topic, will.payload, qos=will.qos, retain=will.retain, owner=self.client_id)

    def _handle(self, frame: Frame) -> None:
        if frame.kind == PUBLISH:
            self._handle_publish(packets.read_publish(frame))
        elif frame.kind == PUBACK:
            self._inflight.discard(packets.read_puback(frame))
            self._send_queued()
        elif frame.kind == PINGREQ:
            self._reply(packets.PINGRESP)
        elif frame.kind == SUBSCRIBE:
            self._handle_subscribe(*packets.read_subscribe(frame))
        elif frame.kind == UNSUBSCRIBE:
            packet_id, filters = packets.read_unsubscribe(frame)
            for pattern in filters:
                self.filters.discard(pattern)
                self._broker.unsubscribe(self, pattern)
            self._reply(packets.unsuback(packet_id))
        elif frame.kind == DISCONNECT:
            self.close("", flush=not self._transport.congested, publish_will=False)
        elif frame.kind == CONNECT:
            self._handle_connect(frame)

    def _handle_connect(self, frame: Frame) -> None:
        client_id = ""
        try:
            connect = packets.read_connect(frame.body)
            client_id = connect.client_id[:64]
            admission = self._broker.authenticate(connect)
            self._check_will(connect.will, admission.grant)
        except packets.UnacceptableProtocol:
            # MQTT 5 clients fall back to 3.1.1 on this response, which must have the 3.1.1 format.
            self._transport.write(packets.connack(packets.BAD_PROTOCOL))
            self.close("", flush=True)
            return
        except Refused as refusal:
            self._transport.write(packets.connack(refusal.code))
            self.close(f"CONNECT as {client_id!r} refused: {refusal}", flush=True)
            return
        self.admission = admission
        self._will = connect.will
        self._keep_alive_s = connect.keep_alive_s * KEEP_ALIVE_FACTOR
        self._framer.accept_all()
        self._transport.admitted()
        self._broker.register(self)
        self._transport.write(packets.connack(packets.ACCEPTED))

    def _check_will(self, will: packets.Will | None, grant: Grant) -> None:
        if will is None:
            return
        if will.qos > packets.MAX_QOS:
            raise Refused(packets.NOT_AUTHORISED, f"the will has QoS {will.qos}; the maximum is {packets.MAX_QOS}")
        if not valid_topic(will.topic, self._limits.topic_bytes) or not grant.may_publish(will.topic):
            raise Refused(packets.NOT_AUTHORISED, "the grant does not permit the topic of the will")
        if will.retain and not topics.may_retain(will.topic):
            raise Refused(packets.NOT_AUTHORISED, "the will is retained, but messages of its class are not")
        if len(will.payload) > (self._limits.retained_bytes if will.retain else self._limits.payload_bytes):
            raise Refused(packets.NOT_AUTHORISED, "the will is too long")

    def _handle_publish(self, message: Publish) -> None:
        topic = message.topic
        if message.qos > packets.MAX_QOS:
            self.close(f"published at QoS {message.qos}; the maximum is {packets.MAX_QOS}")
        elif len(message.payload) > self._limits.payload_bytes:
            self.close(f"published {len(message.payload)} bytes; the maximum is {self._limits.payload_bytes}")
        elif message.retain and len(message.payload) > self._limits.retained_bytes:
            self.close(f"published {len(message.payload)} bytes retained; the maximum is {self._limits.retained_bytes}")
        elif topic not in self._publishable and not self._may_publish(topic):
            self.close(f"published to {topic[:200]!r}, which its grant does not permit")
        elif message.retain and not topics.may_retain(topic):
            self.close(f"published retained to {topic[:200]!r}; messages of this class are not retained")
        elif topic == revocation.TOPIC:
            self._handle_control(message)
        elif not self._broker.publish(
            topic, message.payload, qos=message.qos, retain=message.retain, owner=self.client_id
        ):
            self.close(f"exceeded the limit of retained messages, at {topic[:200]!r}")
        elif message.qos:
            self._reply(packets.puback(message.packet_id))

    def _handle_control(self, message: Publish) -> None:
        try:
            self._broker.revoke(message.payload)
        except ValueError as error:
            self.close(f"invalid control message: {error}")
            return
        if message.qos:
            self._reply(packets.puback(message.packet_id))

    def _may_publish(self, topic: str) -> bool:
        """Check a topic against the grant; permitted topics are cached."""
        assert self.admission is not None  # noqa: S101 (the framer rejects all other packets before CONNECT)
        if topic != revocation.TOPIC and not valid_topic(topic, self._limits.topic_bytes):
            return False
        if not self.admission.grant.may_publish(topic):
            return False
        if len(self._publishable) >= _CACHED_TOPICS:
            self._publishable.clear()
        self._publishable.add(topic)
        return True

    def _handle_subscribe(self, packet_id: int, filters: list[tuple[str, int]]) -> None:
        if len(filters) > self._limits.filters_per_subscribe:
            self.close(f"{len(filters)} filters in one SUBSCRIBE; the maximum is {self._limits.filters_per_subscribe}")
            return
        granted = [(pattern, min(qos, packets.MAX_QOS)) for pattern, qos in filters if self._may_subscribe(pattern)]
        allowed = dict(granted)
        self._reply(packets.suback(packet_id, [allowed.get(pattern, packets.REFUSED) for pattern, _ in filters]))
        for pattern, qos in granted:
            if self._closed:  # closed by the retained messages of the previous filter
                return
            self._broker.subscribe(self, pattern, qos)

    def _may_subscribe(self, pattern: str) -> bool:
        assert self.admission is not None  # noqa: S101 (as above)
        if not valid_filter(pattern, self._limits.topic_bytes) or not self.admission.grant.may_subscribe(pattern):
            return False
        if pattern not in self.filters and len(self.filters) >= self._limits.filters_per_client:
            return False
        self.filters.add(pattern)
        return True

    def _reply(self, packet: bytes) -> None:
        self._transport.write(packet)
        if self._transport.unsent > self._limits.unsent_bytes:
            self.close("the client does not read responses")

    def _may_send(self, qos: int) -> bool:
        return not self._transport.congested and (not qos or len(self._inflight) < self._limits.inflight)

    def _send(self, topic: str, payload: bytes, *, qos: int, retain: bool) -> None:
        if qos:
            while True:
                self._packet_id = self._packet_id % 0xFFFF + 1
                if self._packet_id not in self._inflight:
                    break
            self._inflight.add(self._packet_id)
            self._transport.write(packets.publish(topic, payload, packet_id=self._packet_id, retain=retain))
        else:
            self._transport.write(packets.publish(topic, payload, retain=retain))

    def _send_queued(self) -> None:
        while self._queue and not self._closed and self._may_send(self._queue[0][2]):
            topic, payload, qos, retain = self._queue.popleft()
            self._queue_bytes -= len(payload)
            self._send(topic, payload, qos=qos, retain=retain)
