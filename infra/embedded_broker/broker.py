"""amqtt's broker, hardened.

Of amqtt stay the life cycle, the listeners' configuration and the packet codec. What lies between a socket and a
subscriber is ours: there amqtt 0.12 drops the victim's session before it authenticates whoever claims its client id,
leaves the old socket open on a takeover, sends a new client what is retained for everybody's filters, says wills that
nobody checked, never notices a lost keep-alive, acknowledges what it refuses, raises QoS 0 to the subscription's QoS,
and queues without bound for clients that are away. ``tests/contract/brokers`` has each of them by name.
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
from device_agent.protocol.security.grants import issued_at
from device_agent.protocol.security.revocation import Control
from infra.embedded_broker import packets
from infra.embedded_broker.connection import Admission, Connection, Refused
from infra.embedded_broker.limits import Limits
from infra.embedded_broker.listeners import CLOSE_S, Link, TcpLink, WebSocketLink
from infra.embedded_broker.packets import Connect
from infra.embedded_broker.public_keys import KeyRing, KeysError
from infra.embedded_broker.revocations import Revocations
from infra.embedded_broker.routing import Kept, Retained, Subscriptions

log = logging.getLogger("telescope.broker")

TCP, WEBSOCKET = "default", "websocket"
"""The listeners, by amqtt's name for the first."""
_TICK_S = 0.25
_FRAME_BYTES = 1024 * 1024
"""Largest WebSocket frame [bytes]: it may carry several packets, each of which is bounded by itself."""


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
        """Prepare; ``start`` listens.

        Args:
            sockets: Bound sockets for ``TCP`` and ``WEBSOCKET``: whoever starts the broker finds out about taken ports.
            keys: Read already.
            revocations: Opened already; closed by ``shutdown``.
            limits: Bounds, where the usual ones do not fit.
            tls: What the listeners show; ``None`` where they speak in the clear.
        """
        kinds = {TCP: ListenerType.TCP, WEBSOCKET: ListenerType.WS}
        super().__init__(
            BrokerConfig(
                listeners={name: ListenerConfig(type=kind, bind="127.0.0.1:0") for name, kind in kinds.items()},
                plugins={},  # the usual ones let anybody in and publish $SYS
            )
        )
        self.limits = limits or Limits()
        self._sockets = sockets
        self._tls = tls
        self._keys = keys
        self._revocations = revocations
        self._connections: set[Connection] = set()
        self._clients: dict[str, Connection] = {}
        self._subscriptions_table: Subscriptions[Connection] = Subscriptions()
        self._retained_table = Retained(
            per_client=self.limits.retained_per_client, total_bytes=self.limits.retained_total_bytes
        )
        self._clock: asyncio.Task[None] | None = None

    # ------------------------------------------------------------ life cycle

    async def start(self) -> None:
        """Listen.

        Raises:
            BrokerError: amqtt could not start.
        """
        await super().start()
        self._clock = asyncio.create_task(self._watch_clocks())

    async def shutdown(self) -> None:
        """Cut everybody off and stop. Wills are not said: there is nobody left to hear them."""
        if self._clock is not None:
            self._clock.cancel()
            await asyncio.gather(self._clock, return_exceptions=True)
        for connection in list(self._connections):
            connection.end("", say_will=False)
        await super().shutdown()
        self._revocations.close()

    async def _create_server_instance(
        self,
        listener_name: str,
        listener_type: ListenerType,
        address: str | None,
        port: int,
        ssl_context: Any,
    ) -> Any:
        """Make the server of one listener: the seam that amqtt offers. Where it listens, the bound socket says."""
        del address, port, ssl_context
        bound = self._sockets[listener_name]
        if listener_type == ListenerType.TCP:
            return await asyncio.get_running_loop().create_server(
                lambda: TcpLink(self._connected, congested_bytes=self.limits.congested_bytes),
                sock=bound,
                ssl=self._tls,
                ssl_handshake_timeout=None if self._tls is None else self.limits.connect_timeout_s,
            )
        quiet = logging.getLogger("telescope.broker.websocket")
        quiet.setLevel(logging.CRITICAL + 1)  # it logs every failed handshake with a traceback
        return await websockets.serve(
            self._websocket_connected,
            sock=bound,
            ssl=self._tls,
            subprotocols=[websockets.Subprotocol("mqtt")],
            compression=None,  # costs time for each small message, and lets a small frame become a huge one
            max_size=_FRAME_BYTES,
            ping_interval=None,  # MQTT has its own
            close_timeout=CLOSE_S,
            open_timeout=self.limits.connect_timeout_s,
            logger=quiet,
        )

    async def _websocket_connected(self, websocket: ServerConnection) -> None:
        link = WebSocketLink(websocket, self._connected, congested_bytes=self.limits.congested_bytes)
        await link.serve()

    def _connected(self, link: Link) -> Connection:
        kind = "TCP" if isinstance(link, TcpLink) else "WebSocket"
        connection = Connection(self, link, asyncio.get_running_loop().time(), kind)
        self._connections.add(connection)
        if len(self._connections) > self.limits.connections:
            connection.end(f"more than {self.limits.connections} connections")
        return connection

    async def _watch_clocks(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(_TICK_S)
            try:
                self._refresh_keys()
                now_s, wall_s = loop.time(), time.time()
                for connection in list(self._connections):
                    connection.tick(now_s, wall_s)
            except Exception as error:  # noqa: BLE001 (the clocks have to be looked at again, whatever went wrong)
                log.error("fault in the broker: %s: %s", type(error).__name__, error)  # noqa: TRY400 (no traceback)

    # ------------------------------------------------------------ rights

    def admit(self, connect: Connect) -> Admission:
        """Judge a CONNECT by its token alone.

        Raises:
            Refused: No token, not for this client id or user, run out, or taken back.
        """
        if not connect.client_id:
            raise Refused(packets.BAD_CLIENT_ID, "no client id")
        self._refresh_keys()
        try:
            grant = self._keys.read(connect.password)
        except SignatureError as error:
            raise Refused(packets.NOT_AUTHORISED, str(error)) from error
        if (grant.client_id, grant.principal) != (connect.client_id, connect.username):
            raise Refused(packets.NOT_AUTHORISED, "its token is for another client id or user name")
        now_s = time.time()
        if now_s >= grant.expires_at:
            raise Refused(packets.NOT_AUTHORISED, "its token has run out")
        if grant.expires_at - now_s > self.limits.token_s:
            raise Refused(packets.NOT_AUTHORISED, f"its token runs longer than {self.limits.token_s:.0f} s")
        admission = Admission(grant, connect.password, issued_at(connect.password))
        if self._revocations.covers(grant, admission.issued_at):
            raise Refused(packets.NOT_AUTHORISED, "its token has been revoked")
        return admission

    def instruct(self, payload: bytes) -> None:
        """Do what a message on the control topic says: remember a revocation, and cut what it covers.

        Raises:
            ValueError: It cannot be read.
        """
        revoke = codec.decode(payload, Control).revoke
        try:
            self._revocations.add(revoke)
        except OSError as error:
            log.error("a revocation holds only until the broker's next start: %s", error.strerror)  # noqa: TRY400
        for connection in list(self._clients.values()):
            admission = connection.admission
            if admission is not None and self._revocations.covers(admission.grant, admission.issued_at):
                connection.end("its token has been revoked")

    def _refresh_keys(self) -> None:
        try:
            if not self._keys.refresh():
                return
        except KeysError as error:
            log.error("%s; the keys from before stay in force", error)  # noqa: TRY400 (its text is all there is)
            return
        for connection in list(self._clients.values()):
            try:
                if connection.admission is not None:
                    self._keys.read(connection.admission.token)
            except SignatureError:
                connection.end("the key of its token has been withdrawn")

    # ------------------------------------------------------------ the exchange

    def enter(self, connection: Connection) -> None:
        """Make an admitted connection the one of its client id; whoever had it before is cut off."""
        before = self._clients.get(connection.client_id)
        if before is not None:
            before.end("its client id connected again")
        self._clients[connection.client_id] = connection

    def leave(self, connection: Connection) -> None:
        """Forget a connection."""
        self._connections.discard(connection)
        if self._clients.get(connection.client_id) is connection:
            del self._clients[connection.client_id]
        for pattern in connection.filters:
            self._subscriptions_table.remove(connection, pattern)
        connection.filters.clear()

    def subscribe(self, connection: Connection, pattern: str, qos: int) -> None:
        """Add a filter, and tell this connection, and no other, what is retained for it."""
        self._subscriptions_table.add(connection, pattern, qos)
        for topic, kept in self._retained_table.matching(pattern):
            connection.deliver(topic, kept.payload, qos=min(qos, kept.qos), retain=True)

    def unsubscribe(self, connection: Connection, pattern: str) -> None:
        """Take a filter back."""
        self._subscriptions_table.remove(connection, pattern)

    def publish(self, topic: str, payload: bytes, *, qos: int, retain: bool, owner: str) -> bool:
        """Hand a message to all who hear it, at the lower of its QoS and theirs, and keep it where it is retained.

        Returns:
            False where the bounds of what is kept are reached; it was then handed on and not kept.
        """
        packet = b""
        for connection, granted in self._subscriptions_table.hearers(topic):
            if qos and granted:
                connection.deliver(topic, payload, qos=1)
            else:
                packet = packet or packets.publish(topic, payload)
                connection.deliver_packet(packet)
        return not retain or self._retained_table.keep(topic, Kept(payload, qos, owner))
