"""Deadlines of HTTP connections, on a clock that the test sets, and reserved capacity for Stop."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState

from function_app.entrypoints.hosts import http_connection
from function_app.entrypoints.hosts.connection_limits import (
    ACCEPTS_PER_ITERATION,
    AcceptedSocket,
    ConnectionLimits,
    State,
)
from function_app.entrypoints.hosts.http_connection import HEADERS_S, HttpConnection, RequestLimits
from function_app.entrypoints.hosts.uvicorn import listen

HERE = "127.0.0.1"
GET = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
POST = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 100000\r\n\r\n"
STOP = b"POST /api/v1/devices/a/stop HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n"
PARTIAL = b"GET / HTTP/1.1\r\nHost: x\r\nX-Slow: "
HOUR_S = 3_600.0
PATIENCE_S = 60.0


class Server:
    """The connections of uvicorn before an application whose ``GET`` waits for ``answer``."""

    def __init__(self, concurrent: int = 100) -> None:
        self.now_s = 0.0
        self.answer = asyncio.Event()
        self.body = b"ok"
        self.received = 0
        self.requests = 0
        self.limits = ConnectionLimits(total=100, per_address=0, waiting_s=HEADERS_S, now_s=lambda: self.now_s)
        self._app = RequestLimits(self._respond, limits=self.limits, concurrent=concurrent)
        self._server: asyncio.Server | None = None
        self._writers: list[asyncio.StreamWriter] = []

    async def start(self) -> None:
        config = uvicorn.Config(self._app, log_level="error", lifespan="off", ws="none")
        protocol: Any = partial(
            HttpConnection, config=config, server_state=ServerState(), app_state={}, limits=self.limits
        )
        self._server = await asyncio.get_running_loop().create_server(
            protocol, sock=self.limits.listener(listen(HERE, 0)), backlog=ACCEPTS_PER_ITERATION
        )

    async def connect(self, sent: bytes) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A client whose connection the server has accepted."""
        assert self._server is not None
        before = self.limits.open
        reader, writer = await asyncio.open_connection(*self._server.sockets[0].getsockname(), limit=1_024)
        self._writers.append(writer)
        writer.write(sent)
        await until(lambda: self.limits.open > before)
        return reader, writer

    def states(self) -> list[State]:
        return [connection.state for connection in self.limits._sockets.values()]

    def is_active(self, count: int) -> bool:
        return self.states().count(State.ACTIVE) == count

    def has_received(self, count: int) -> bool:
        return self.received == count

    def ended_after(self, seconds: float) -> int:
        """Advance the clock; returns how many connections have ended since the start."""
        self.now_s += seconds
        self.limits.end_late()
        return self.limits.ended

    async def close(self) -> None:
        assert self._server is not None
        self._server.close()
        for writer in self._writers:
            writer.transport.abort()
        await until(lambda: self.limits.open == 0)

    async def _respond(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.requests += 1
        if scope["method"] == "GET":
            await self.answer.wait()
        while (message := await receive())["type"] == "http.request":
            self.received += len(message["body"])
            if not message["more_body"]:
                break
        length = str(len(self.body)).encode()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", length)]})
        await send({"type": "http.response.body", "body": self.body})


def run(test: Callable[[Server], Awaitable[None]], **options: int) -> None:
    """Run a test on a started server."""

    async def body() -> None:
        server = Server(**options)
        await server.start()
        try:
            async with asyncio.timeout(PATIENCE_S):
                await test(server)
        finally:
            await server.close()

    asyncio.run(body())


async def until(condition: Callable[[], object]) -> None:
    while not condition():  # noqa: ASYNC110 (the server has no event for this)
        await asyncio.sleep(0)


@pytest.mark.parametrize("sent", [b"", PARTIAL], ids=["nothing", "partial"])
def test_headers_must_arrive_within_their_deadline(sent: bytes) -> None:
    async def test(server: Server) -> None:
        reader, _ = await server.connect(sent)
        assert server.ended_after(HEADERS_S - 0.1) == 0
        assert server.ended_after(0.2) == 1
        with contextlib.suppress(ConnectionResetError):
            assert await reader.read() == b""
        await until(lambda: server.limits.open == 0)

    run(test)


def test_a_further_request_has_the_same_deadline_but_an_idle_connection_has_none() -> None:
    async def test(server: Server) -> None:
        server.answer.set()
        _, writer = await server.connect(GET)
        await until(lambda: server.states() == [State.IDLE])
        assert server.ended_after(HOUR_S) == 0
        writer.write(PARTIAL)
        await until(lambda: server.states() == [State.WAITING])
        assert server.ended_after(HEADERS_S + 0.1) == 1

    run(test)


def test_a_body_may_be_slow_but_must_not_stop() -> None:
    async def test(server: Server) -> None:
        _, writer = await server.connect(POST)
        await until(lambda: server.requests == 1)
        for part in range(1, 6):
            writer.write(bytes(8_192))
            await until(partial(server.has_received, part * 8_192))
            assert server.ended_after(2.0) == 0
        assert server.ended_after(10.1) == 1

    run(test)


def test_a_request_may_wait_for_its_response() -> None:
    async def test(server: Server) -> None:
        reader, _ = await server.connect(GET)
        await until(lambda: server.states() == [State.ACTIVE])
        assert server.ended_after(HOUR_S) == 0
        server.answer.set()
        assert (await reader.readline()).startswith(b"HTTP/1.1 200")

    run(test)


def test_a_response_must_be_read() -> None:
    async def test(server: Server) -> None:
        server.body = bytes(20_000_000)
        server.answer.set()
        await server.connect(GET)
        await until(lambda: min((each.deadline_s for each in _sockets(server)), default=0.0) == 30.0)
        assert server.ended_after(29.0) == 0
        assert server.ended_after(1.1) == 1
        await until(lambda: server.limits.open == 0)

    run(test)


def test_stop_is_accepted_while_too_many_requests_are_processed() -> None:
    async def test(server: Server) -> None:
        for number in range(3):
            reader, _ = await server.connect(GET)
            await until(partial(server.is_active, min(number + 1, 2)))
        assert (await reader.readline()).startswith(b"HTTP/1.1 503")
        reader, _ = await server.connect(STOP)
        assert (await reader.readline()).startswith(b"HTTP/1.1 200")

    run(test, concurrent=2)


def test_a_handler_that_does_not_respond_is_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_connection, "_HANDLER_S", 0.01)

    async def test(server: Server) -> None:
        reader, _ = await server.connect(GET)
        assert (await reader.readline()).startswith(b"HTTP/1.1 503")

    run(test)


def _sockets(server: Server) -> list[AcceptedSocket]:
    return list(server.limits._sockets.values())
