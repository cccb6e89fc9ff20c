"""The connection of the cloud to the XMPP server, with slixmpp."""

import asyncio
import logging
import random
import secrets
from collections.abc import Awaitable, Callable

from device_agent.protocol.xmpp.jids import CLOUD
from device_agent.protocol.xmpp.stream import Login, Stream
from function_app.domain.common.problems import Problem
from function_app.ports.tables import StoreError
from function_app.ports.xmpp_connection import Listener

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 5.0
MAX_UNSENT_BYTES = 1024 * 1024

_log = logging.getLogger(__name__)


class SlixmppConnection:
    """``XmppConnection`` to one server. Each connection uses a new password and a new resource."""

    def __init__(self, *, host: str, port: int, domain: str, password: Callable[[], Awaitable[str]]) -> None:
        self._host = host
        self._port = port
        self._domain = domain
        self._password = password
        self._stream: Stream | None = None
        self._problem = ""

    @property
    def domain(self) -> str:
        return self._domain

    async def run(self, listener: Listener) -> None:
        pause_s = FIRST_RETRY_S
        while True:
            try:
                stream = await self._open(listener)
                try:
                    self._stream, self._problem, pause_s = stream, "", FIRST_RETRY_S
                    _log.info("connected to the XMPP server at %s:%d", self._host, self._port)
                    await stream.stay()
                finally:
                    self._stream = None
                    await stream.close()
                    listener.lost()
            except (OSError, StoreError, Problem) as error:
                if str(error) != self._problem:
                    _log.warning("XMPP: %s", error)
                self._problem = str(error)
            await asyncio.sleep(pause_s * random.uniform(0.5, 1.0))  # noqa: S311 (spreads reconnects, hides nothing)
            pause_s = min(2 * pause_s, LAST_RETRY_S)

    async def _open(self, listener: Listener) -> Stream:
        jid = f"{CLOUD}@{self._domain}/{secrets.token_hex(8)}"
        login = Login(self._host, self._port, jid, await self._password())
        stream = Stream(login, message=listener.message, presence=listener.presence)
        try:
            await stream.open()
        except BaseException:
            await stream.close()
            raise
        return stream

    def send(self, stanza: str) -> bool:
        return self._stream is not None and self._stream.send(stanza)

    def congested(self) -> bool:
        return self._stream is not None and self._stream.unsent_bytes > MAX_UNSENT_BYTES
