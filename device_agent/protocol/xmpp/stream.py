"""One XMPP connection, as both ends of the wire contract need it: slixmpp, bare, in the event loop that runs.

Of slixmpp come the stream, its security and the login. What it does for chat clients is left out: each of our stanzas
goes to one callback, and what is sent is written at once (asyncio sets TCP_NODELAY).
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
_GOODBYE_S = 0.2
_GOODBYE_LOOKS = 20
_CLIENT = "jabber:client"
_HANDLERS_FOR_CHAT = ("IM", "IMError", "Presence", "Roster Update")

_log = logging.getLogger(__name__)
# It writes down whole stanzas, passwords among them, and reports as errors what is raised here anyway.
logging.getLogger("slixmpp").setLevel(logging.CRITICAL)


class StreamError(OSError):
    """No connection, or it was lost. The text says why."""


@dataclass(frozen=True, slots=True)
class Login:
    """Where and as whom to connect. ``jid`` has a resource, or the server chooses one."""

    host: str
    port: int
    jid: str
    password: str = field(repr=False)

    @property
    def domain(self) -> str:
        """The part of the JID that names the server."""
        return self.jid.partition("/")[0].partition("@")[2]

    @property
    def local(self) -> bool:
        """Whether the server is on this machine: only then may the stream be in the clear."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


class Stream:
    """One connection; ``open`` once, then ``stay`` until it is lost.

    Args:
        login: Where and as whom.
        message: Given each ``<message>``.
        presence: Given each ``<presence>``.
    """

    def __init__(
        self, login: Login, *, message: Callable[[Element], None], presence: Callable[[Element], None]
    ) -> None:
        self._login = login
        self._message = message
        self._presence = presence
        self._client: _Client | None = None
        self._lost = asyncio.Event()
        self._why = "the connection was closed"

    @property
    def jid(self) -> str:
        """The whole JID, with the resource that the server gave."""
        return "" if self._client is None else str(self._client.boundjid.full)

    @property
    def unsent_bytes(self) -> int:
        """What the kernel has not taken yet [bytes]."""
        transport: Any = None if self._client is None else self._client.transport
        return 0 if transport is None else int(transport.get_write_buffer_size())

    async def open(self) -> None:
        """Connect, log in, and say that we are there.

        Raises:
            StreamError: Not reached, not secure, or refused.
        """
        login = self._login
        ready = asyncio.get_running_loop().create_future()
        client = self._client = _Client(login)
        client.register_handler(Callback("message", MatchXPath(f"{{{_CLIENT}}}message"), self._on(self._message)))
        client.register_handler(Callback("presence", MatchXPath(f"{{{_CLIENT}}}presence"), self._on(self._presence)))

        def settled(_: object) -> None:
            if not ready.done():
                ready.set_result(None)

        def failed(why: str) -> Callable[[object], None]:
            def fail(detail: object) -> None:
                self._why = f"{why}: {detail}" if isinstance(detail, OSError | str) else why
                self._lost.set()
                if not ready.done():
                    ready.set_exception(StreamError(f"{login.host}:{login.port}: {self._why}"))

            return fail

        client.add_event_handler("session_start", settled)
        client.add_event_handler("connection_failed", failed("cannot be reached"))
        client.add_event_handler("failed_all_auth", failed("the XMPP server refuses the password, or has no TLS"))
        client.add_event_handler("ssl_invalid_chain", failed("the certificate is not one that this machine trusts"))
        client.add_event_handler("disconnected", failed("the connection was lost"))
        try:
            async with asyncio.timeout(_LOGIN_S):
                client.connect(login.host, login.port)
                await ready
        except TimeoutError as error:
            raise StreamError(f"{login.host}:{login.port} does not answer as an XMPP server") from error
        self.send(stanzas.presence())

    async def stay(self) -> None:
        """Keep the connection until it is lost.

        Raises:
            StreamError: It is.
        """
        loop = asyncio.get_running_loop()
        client = self._client
        assert client is not None  # noqa: S101 (after `open`)
        question = stanzas.ping(self._login.domain)
        while not self._lost.is_set():
            if loop.time() - client.heard_s > stanzas.DEAD_S:
                raise StreamError(f"the XMPP server has said nothing for {stanzas.DEAD_S:.0f} s")
            self.send(question)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(stanzas.PING_S):
                    await self._lost.wait()
        raise StreamError(self._why)

    def send(self, stanza: str) -> bool:
        """Write a stanza; ``False`` where the connection is gone."""
        client = self._client
        if client is None or client.transport is None or self._lost.is_set():
            return False
        client.send_raw(stanza)
        return True

    async def close(self) -> None:
        """Say goodbye, briefly, and let go. May be called twice."""
        client, self._client = self._client, None
        if client is None:
            return
        self._lost.set()
        client.cancel_connection_attempt()
        transport: Any = client.transport
        if transport is not None:
            # The server tells everybody who knows us; whether it closes its side is of no interest.
            client.send_raw(stanzas.presence(available=False) + client.stream_footer)
            for _ in range(_GOODBYE_LOOKS):
                if not transport.get_write_buffer_size():
                    break
                await asyncio.sleep(_GOODBYE_S / _GOODBYE_LOOKS)
            transport.abort()  # under TLS, `close` would wait for the other side
        await client.quit()
        await asyncio.sleep(0)  # the socket is closed by the loop's next turn

    def _on(self, handle: Callable[[Element], None]) -> Callable[[Any], None]:
        def run(stanza: Any) -> None:
            try:
                handle(stanza.xml)
            except Exception:  # noqa: BLE001 (one bad stanza must not end the connection)
                _log.exception("stanza")

        return run


class _Client(ClientXMPP):  # type: ignore[misc]  # slixmpp is not looked into
    """slixmpp's client without what it does for chat."""

    def __init__(self, login: Login) -> None:
        self.heard_s = 0.0
        # Before the base class: it looks for a loop by itself, in ways that are no longer wanted.
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
        self.heard_s = loop.time()

    def data_received(self, data: bytes) -> None:
        """Take note that the server lives."""
        self.heard_s = self.loop.time()
        super().data_received(data)

    async def quit(self) -> None:
        """End the tasks that slixmpp leaves behind."""
        task = self._run_out_filters
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
