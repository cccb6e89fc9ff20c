"""amqtt's broker, hardened.

amqtt provides the life cycle, the listener configuration and the packet codec. Everything between socket and
subscriber is replaced, because amqtt 0.12 drops an existing session before it authenticates a client with the same id,
leaves the old socket open on a takeover, sends retained messages of all filters to a new client, publishes unchecked
wills, never notices a lost keep-alive, acknowledges rejected messages, raises QoS 0 to the subscription's QoS, and
queues without limit for offline clients. ``tests/contract/brokers`` has a test for each.
"""

import asyncio
import logging
import socket
import ssl
import time
from collections.abc import Mapping
from typing import Any

import websockets
from amqtt.broker import Broker
from amqtt.contexts import BrokerConfig, ListenerConfig, ListenerType
from websockets.asyncio.server import ServerConnection

from device_agent.protocol import codec
from device_agent.protocol.errors import SignatureError
from device_agent.protocol.security.grants import Grant, issued_at
from device_agent.protocol.security.revocation import Control
from function_app.entrypoints.hosts.connection_limits import ACCEPTS_PER_ITERATION, ConnectionLimits
from infra.embedded_broker import packets
from infra.embedded_broker.connection import Admission, Connection, Refused
from infra.embedded_broker.limits import SERVICE, Limits
from infra.embedded_broker.listeners import CLOSE_S, TcpTransport, Transport, WebSocketTransport
from infra.embedded_broker.packets import Connect
from infra.embedded_broker.public_keys import KeyRing, KeysError
from infra.embedded_broker.revocations import Revocations
from infra.embedded_broker.routing import RetainedMessage, RetainedMessages, Subscriptions

log = logging.getLogger("telescope.broker")

TCP, WEBSOCKET = "default", "websocket"
"""Listener names; the first is amqtt's default."""
_TICK_S = 0.25
_PRIORITY = ("agent:", SERVICE)
"""Beginnings of the principals of agents and of the functions."""
_RESERVED_SHARE = 10
"""One in this number of clients is reserved for them."""
_FRAME_BYTES = 1024 * 1024
"""Largest WebSocket frame [bytes]; it may contain several packets, each with its own limit."""


class TelescopeBroker(Broker):  # type: ignore[misc]  # amqtt is not typed
    """A broker for one machine: default deny, signed grants, clean sessions, QoS 0 and 1, MQTT 3.1.1."""

    def __init__(
        self,
        *,
        sockets: Mapping[str, socket.socket],
        keys: KeyRing,
        revocations: Revocations,
        limits: Limits | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        """Prepare the broker; ``start`` listens.

        Args:
            sockets: Bound sockets for ``TCP`` and ``WEBSOCKET``; the caller thus detects ports in use.
            keys: The key ring, already read.
            revocations: Already open; ``shutdown`` closes it.
            limits: Limits other than the defaults.
            tls: TLS context of the listeners; ``None`` without TLS.
        """
        kinds = {TCP: ListenerType.TCP, WEBSOCKET: ListenerType.WS}
        super().__init__(
            BrokerConfig(
                listeners={name: ListenerConfig(type=kind, bind="127.0.0.1:0") for name, kind in kinds.items()},
                plugins={},  # the default plugins allow anonymous clients and publish $SYS
            )
        )
        self.limits = limits or Limits()
        self._pending = ConnectionLimits(
            total=self.limits.pending,
            per_address=self.limits.pending_per_address,
            waiting_s=self.limits.connect_timeout_s,
        )
        self._sockets = sockets
        self._tls = tls
        self._keys = keys
        self._revocations = revocations
        self._connections: set[Connection] = set()
        self._clients: dict[str, Connection] = {}
        self._subscriptions_table: Subscriptions[Connection] = Subscriptions()
        self._retained_table = RetainedMessages(
            per_client=self.limits.retained_per_client, total_bytes=self.limits.retained_total_bytes
        )
        self._timer_task: asyncio.Task[None] | None = None

    # ------------------------------------------------------------ life cycle

    async def start(self) -> None:
        """Listen.

        Raises:
            BrokerError: amqtt could not start.
        """
        await super().start()
        self._timer_task = asyncio.create_task(self._run_timers())

    async def shutdown(self) -> None:
        """Close all connections, without wills, and stop."""
        if self._timer_task is not None:
            self._timer_task.cancel()
            await asyncio.gather(self._timer_task, return_exceptions=True)
        for connection in list(self._connections):
            connection.close("", publish_will=False)
        await super().shutdown()
        self._revocations.close()

    async def _create_server_instance(
        self, listener_name: str, listener_type: ListenerType, address: str | None, port: int, ssl_context: Any
    ) -> Any:
        """Create the server of one listener on its bound socket; overrides amqtt."""
        del address, port, ssl_context
        listening_socket = self._pending.listener(self._sockets[listener_name])
        if listener_type == ListenerType.TCP:
            return await asyncio.get_running_loop().create_server(
                lambda: TcpTransport(self._connected, self._pending, congested_bytes=self.limits.congested_bytes),
                sock=listening_socket,
                backlog=ACCEPTS_PER_ITERATION,
                ssl=self._tls,
                ssl_handshake_timeout=None if self._tls is None else self.limits.connect_timeout_s,
            )
        quiet = logging.getLogger("telescope.broker.websocket")
        quiet.setLevel(logging.CRITICAL + 1)  # it logs every failed handshake with a traceback
        return await websockets.serve(
            self._websocket_connected,
            sock=listening_socket,
            backlog=ACCEPTS_PER_ITERATION,
            ssl=self._tls,
            subprotocols=[websockets.Subprotocol("mqtt")],
            compression=None,  # slow for small messages, and permits decompression bombs
            max_size=_FRAME_BYTES,
            ping_interval=None,  # MQTT has its own keep-alive
            close_timeout=CLOSE_S,
            open_timeout=self.limits.connect_timeout_s,
            logger=quiet,
        )

    async def _websocket_connected(self, websocket: ServerConnection) -> None:
        transport = WebSocketTransport(
            websocket, self._connected, self._pending, congested_bytes=self.limits.congested_bytes
        )
        await transport.serve()

    def _connected(self, transport: Transport) -> Connection:
        kind = "TCP" if isinstance(transport, TcpTransport) else "WebSocket"
        connection = Connection(self, transport, time.monotonic(), kind)
        self._connections.add(connection)
        return connection

    async def _run_timers(self) -> None:
        while True:
            await asyncio.sleep(_TICK_S)
            try:
                self._refresh_keys()
                self._pending.end_late()
                self._report_ended()
                now_s, wall_s = time.monotonic(), time.time()
                for connection in list(self._connections):
                    connection.tick(now_s, wall_s)
            except Exception as error:  # noqa: BLE001 (the loop must continue after any error)
                log.error("internal error: %s: %s", type(error).__name__, error)  # noqa: TRY400 (no traceback)

    def _report_ended(self) -> None:
        if self._pending.ended:
            log.warning("connections without a complete CONNECT were closed: late, or replaced by new ones")
            self._pending.ended = 0

    # ------------------------------------------------------------ authentication

    def authenticate(self, connect: Connect) -> Admission:
        """Authenticate a CONNECT by its token.

        Raises:
            Refused: No token, a token for another client or user, or an expired or revoked token.
        """
        if not connect.client_id:
            raise Refused(packets.BAD_CLIENT_ID, "no client id")
        self._refresh_keys()
        try:
            grant = self._keys.read(connect.password)
        except SignatureError as error:
            raise Refused(packets.NOT_AUTHORISED, str(error)) from error
        if (grant.client_id, grant.principal) != (connect.client_id, connect.username):
            raise Refused(packets.NOT_AUTHORISED, "the token belongs to another client id or user name")
        now_s = time.time()
        if now_s >= grant.expires_at:
            raise Refused(packets.NOT_AUTHORISED, "the token has expired")
        longest_s = self.limits.lifetime_s(grant.principal)
        if grant.expires_at - now_s > longest_s:
            raise Refused(packets.NOT_AUTHORISED, f"the token's lifetime exceeds {longest_s:.0f} s")
        admission = Admission(grant, connect.password, issued_at(connect.password))
        if self._revocations.covers(grant, admission.issued_at):
            raise Refused(packets.NOT_AUTHORISED, "the token has been revoked")
        self._require_room(grant)
        return admission

    def _require_room(self, grant: Grant) -> None:
        """Reject a client above the limit. A part of it is reserved for agents and for the functions."""
        limit = self.limits.connections
        if not grant.principal.startswith(_PRIORITY):
            limit -= limit // _RESERVED_SHARE
        if grant.client_id not in self._clients and len(self._clients) >= limit:
            raise Refused(packets.UNAVAILABLE, f"{len(self._clients)} clients are connected; the maximum is {limit}")

    def revoke(self, payload: bytes) -> None:
        """Apply a message of the control topic: store the revocation and close the connections that it covers.

        Raises:
            ValueError: The message is invalid.
        """
        revoke = codec.decode(payload, Control).revoke
        try:
            self._revocations.add(revoke)
        except OSError as error:
            log.error("cannot store a revocation; it is lost at the next start of the broker: %s", error.strerror)  # noqa: TRY400
        for connection in list(self._clients.values()):
            admission = connection.admission
            if admission is not None and self._revocations.covers(admission.grant, admission.issued_at):
                connection.close("the token has been revoked")

    def _refresh_keys(self) -> None:
        try:
            if not self._keys.refresh():
                return
        except KeysError as error:
            log.error("%s; the previous keys stay in use", error)  # noqa: TRY400 (no traceback)
            return
        for connection in list(self._clients.values()):
            try:
                if connection.admission is not None:
                    self._keys.read(connection.admission.token)
            except SignatureError:
                connection.close("the key of the token has been withdrawn")

    # ------------------------------------------------------------ for connections

    def register(self, connection: Connection) -> None:
        """Register an admitted connection under its client id; closes the previous one."""
        previous = self._clients.get(connection.client_id)
        if previous is not None:
            previous.close("another connection uses its client id")
        self._clients[connection.client_id] = connection

    def unregister(self, connection: Connection) -> None:
        """Unregister a connection. Called once for each, admitted or not."""
        self._connections.discard(connection)
        if self._clients.get(connection.client_id) is connection:
            del self._clients[connection.client_id]
        for pattern in connection.filters:
            self._subscriptions_table.remove(connection, pattern)
        connection.filters.clear()

    def subscribe(self, connection: Connection, pattern: str, qos: int) -> None:
        """Add a filter and send its retained messages to this connection only."""
        self._subscriptions_table.add(connection, pattern, qos)
        for topic, message in self._retained_table.matching(pattern):
            connection.deliver(topic, message.payload, qos=min(qos, message.qos), retain=True)

    def unsubscribe(self, connection: Connection, pattern: str) -> None:
        """Remove a filter."""
        self._subscriptions_table.remove(connection, pattern)

    def publish(self, topic: str, payload: bytes, *, qos: int, retain: bool, owner: str) -> bool:
        """Send a message to all subscribers, at the lower of its QoS and theirs, and retain it if requested.

        Returns:
            False if the limits for retained messages are reached; the message was then sent but not retained.
        """
        packet = b""
        for connection, granted in self._subscriptions_table.subscribers(topic):
            if qos and granted:
                connection.deliver(topic, payload, qos=1)
            else:
                packet = packet or packets.publish(topic, payload)
                connection.deliver_packet(packet)
        return not retain or self._retained_table.store(topic, RetainedMessage(payload, qos, owner))
