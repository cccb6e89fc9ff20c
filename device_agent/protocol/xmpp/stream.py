"""One XMPP connection for either end of the wire contract, on slixmpp and the running event loop.

slixmpp provides the stream, TLS and the login. Its chat features are not used: each stanza goes to one callback, and
sent stanzas are written immediately (asyncio sets TCP_NODELAY).
"""

import asyncio
import contextlib
import ipaddress
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

from slixmpp import ClientXMPP
from slixmpp.xmlstream.handler import Callback
from slixmpp.xmlstream.matcher import MatchXPath

from device_agent.protocol.xmpp import stanzas

_LOGIN_S = 5.0
_FLUSH_S = 0.2
_FLUSH_POLLS = 20
_CLIENT = "jabber:client"
_HANDLERS_FOR_CHAT = ("IM", "IMError", "Presence", "Roster Update")

_log = logging.getLogger(__name__)
# slixmpp logs whole stanzas including passwords, and logs errors that are raised here anyway.
logging.getLogger("slixmpp").setLevel(logging.CRITICAL)


class StreamError(OSError):
    """The connection failed or was lost. The message names the cause."""


@dataclass(frozen=True, slots=True)
class Login:
    """Server and credentials. If ``jid`` has no resource, the server assigns one."""

    host: str
    port: int
    jid: str
    password: str = field(repr=False)

    @property
    def domain(self) -> str:
        """The server part of the JID."""
        return self.jid.partition("/")[0].partition("@")[2]

    @property
    def local(self) -> bool:
        """Whether the server is on this machine; only then is a stream without TLS allowed."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


class Stream:
    """One connection. Call ``open`` once, then ``stay`` until the connection is lost.

    Args:
        login: Server and credentials.
        message: Receives each ``<message>``.
        presence: Receives each ``<presence>``.
    """

    def __init__(
        self, login: Login, *, message: Callable[[Element], None], presence: Callable[[Element], None]
    ) -> None:
        self._login = login
        self._message = message
        self._presence = presence
        self._client: _Client | None = None
        self._lost = asyncio.Event()
        self._reason = "the connection was closed"

    @property
    def jid(self) -> str:
        """The full JID with the assigned resource."""
        return "" if self._client is None else str(self._client.boundjid.full)

    @property
    def unsent_bytes(self) -> int:
        """Size of the send buffer [bytes]."""
        transport: Any = None if self._client is None else self._client.transport
        return 0 if transport is None else int(transport.get_write_buffer_size())

    async def open(self) -> None:
        """Connect, log in and send presence.

        Raises:
            StreamError: The server cannot be reached, is not secure, or rejects the login.
        """
        login = self._login
        ready = asyncio.get_running_loop().create_future()
        client = self._client = _Client(login)
        client.register_handler(Callback("message", MatchXPath(f"{{{_CLIENT}}}message"), self._on(self._message)))
        client.register_handler(Callback("presence", MatchXPath(f"{{{_CLIENT}}}presence"), self._on(self._presence)))

        def established(_: object) -> None:
            if not ready.done():
                ready.set_result(None)

        def failed(reason: str) -> Callable[[object], None]:
            def fail(detail: object) -> None:
                self._reason = f"{reason}: {detail}" if isinstance(detail, OSError | str) else reason
                self._lost.set()
                if not ready.done():
                    ready.set_exception(StreamError(f"{login.host}:{login.port}: {self._reason}"))

            return fail

        client.add_event_handler("session_start", established)
        client.add_event_handler("connection_failed", failed("cannot be reached"))
        client.add_event_handler("failed_all_auth", failed("the XMPP server rejects the password, or has no TLS"))
        client.add_event_handler("ssl_invalid_chain", failed("this machine does not trust the server's certificate"))
        client.add_event_handler("disconnected", failed("the connection was lost"))
        try:
            async with asyncio.timeout(_LOGIN_S):
                client.connect(login.host, login.port)
                await ready
        except TimeoutError as error:
            raise StreamError(f"{login.host}:{login.port} does not respond as an XMPP server") from error
        self.send(stanzas.presence())

    async def stay(self) -> None:
        """Keep the connection alive until it is lost.

        Raises:
            StreamError: The connection was lost.
        """
        loop = asyncio.get_running_loop()
        client = self._client
        assert client is not None  # noqa: S101 (after `open`)
        ping = stanzas.ping(self._login.domain)
        while not self._lost.is_set():
            if loop.time() - client.last_traffic_s > stanzas.TIMEOUT_S:
                raise StreamError(f"the XMPP server sent nothing for {stanzas.TIMEOUT_S:.0f} s")
            self.send(ping)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(stanzas.PING_INTERVAL_S):
                    await self._lost.wait()
        raise StreamError(self._reason)

    def send(self, stanza: str) -> bool:
        """Write a stanza. Returns ``False`` if there is no connection."""
        client = self._client
        if client is None or client.transport is None or self._lost.is_set():
            return False
        client.send_raw(stanza)
        return True

    async def close(self) -> None:
        """Disconnect. May be called repeatedly."""
        client, self._client = self._client, None
        if client is None:
            return
        self._lost.set()
        client.cancel_connection_attempt()
        transport: Any = client.transport
        if transport is not None:
            # The server informs all contacts; there is no need to wait until it closes its side.
            client.send_raw(stanzas.presence(available=False) + client.stream_footer)
            for _ in range(_FLUSH_POLLS):
                if not transport.get_write_buffer_size():
                    break
                await asyncio.sleep(_FLUSH_S / _FLUSH_POLLS)
            transport.abort()  # under TLS, `close` would wait for the peer
        await client.quit()
        await asyncio.sleep(0)  # the loop closes the socket in its next iteration

    def _on(self, handle: Callable[[Element], None]) -> Callable[[Any], None]:
        def run(stanza: Any) -> None:
            try:
                handle(stanza.xml)
            except Exception:  # noqa: BLE001 (one bad stanza must not end the connection)
                _log.exception("stanza")

        return run


class _Client(ClientXMPP):  # type: ignore[misc]  # slixmpp has no type information
    """slixmpp's client without its chat features."""

    def __init__(self, login: Login) -> None:
        self.last_traffic_s = 0.0
        # Before the base class, whose own lookup of a loop is deprecated.
        loop = asyncio.get_running_loop()
        super().__init__(
            login.jid,
            login.password,
            loop=loop,
            plugin_config={"feature_mechanisms": {"unencrypted_plain": login.local}},
            sasl_mech="PLAIN",
        )
        for name in _HANDLERS_FOR_CHAT:
            self.remove_handler(name)
        self.enable_direct_tls = False
        self.enable_starttls = not login.local
        self.enable_plaintext = login.local
        self.whitespace_keepalive = False
        self.last_traffic_s = loop.time()

    def data_received(self, data: bytes) -> None:
        """Record the time of the last traffic."""
        self.last_traffic_s = self.loop.time()
        super().data_received(data)

    async def quit(self) -> None:
        """Cancel tasks that slixmpp leaves running."""
        task = self._run_out_filters
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
