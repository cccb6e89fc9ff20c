"""HTTP connections of uvicorn with deadlines, and requests with a limit and a deadline.

uvicorn has a keep-alive timeout only: a client that sends half a request keeps its connection without end.
"""

import asyncio
from asyncio import BaseTransport
from typing import Any

import h11
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from function_app.domain.common.problems import Problem
from function_app.entrypoints.hosts.connection_limits import AcceptedSocket, ConnectionLimits, State
from function_app.entrypoints.http.framework.authentication import AUTHENTICATED, is_stop
from function_app.entrypoints.http.framework.responses import problem

HEADERS_S = 10.0
"""Time from accepting a connection, or from the first byte of a further request, to the end of the headers [s]."""
_BODY_S = 10.0
"""Time for a request body [s], in addition to the time at the lowest rate."""
_BODY_BYTES_PER_S = 4_096
"""Lowest rate at which a request body must arrive."""
_UNREAD_S = 30.0
"""Time for a client to continue to read a response [s]."""
_CLOSE_S = 5.0
"""Time for a client to read the end of a response on a connection that closes [s]."""
_HANDLER_S = 60.0
"""Time from the end of the request to the begin of the response [s]. The longest wait of a request is 30 s."""
_NEVER_S = float("inf")


class HttpConnection(H11Protocol):
    """One connection; keeps its state and deadline in ``limits``."""

    def __init__(self, *args: Any, limits: ConnectionLimits, **options: Any) -> None:
        super().__init__(*args, **options)
        self._limits = limits
        self._socket: AcceptedSocket | None = None
        self._deadline_s = _NEVER_S
        self._read_by_s = _NEVER_S
        self._phase: object = None

    def connection_made(self, transport: BaseTransport) -> None:
        """See ``asyncio.Protocol``."""
        super().connection_made(transport)  # type: ignore[arg-type]
        self._socket = self._limits.attach(transport)
        self._phase = h11.IDLE
        self._deadline_s = self._limits.now_s() + HEADERS_S

    def data_received(self, data: bytes) -> None:
        """See ``asyncio.Protocol``."""
        super().data_received(data)
        self._update(len(data))

    def on_response_complete(self) -> None:
        """See ``H11Protocol``; also called for each response of pipelined requests."""
        super().on_response_complete()
        self._update(0)

    def pause_writing(self) -> None:
        """See ``asyncio.Protocol``."""
        super().pause_writing()
        self._read_by_s = self._limits.now_s() + _UNREAD_S
        self._mark(None)

    def resume_writing(self) -> None:
        """See ``asyncio.Protocol``."""
        super().resume_writing()
        self._read_by_s = _NEVER_S
        self._mark(None)

    def _unsupported_upgrade_warning(self) -> None:
        """Answer as to any other request, without a line in the log."""

    def _update(self, received: int) -> None:
        """Determine what the connection waits for, and until when."""
        phase: object = self.conn.their_state
        state = State.WAITING
        started = phase is not self._phase
        if self.transport.is_closing():
            state, phase = State.IDLE, h11.CLOSED
            if self._phase is not phase:
                self._deadline_s = self._limits.now_s() + _CLOSE_S
        elif phase is h11.SEND_BODY:
            if started:
                self._deadline_s = self._limits.now_s() + _BODY_S
            self._deadline_s += received / _BODY_BYTES_PER_S
        elif phase is not h11.IDLE or (self.cycle is not None and not self.cycle.response_complete):
            state, self._deadline_s = State.ACTIVE, _NEVER_S
        elif self.cycle is not None and not self.conn.trailing_data[0]:
            state, phase, self._deadline_s = State.IDLE, None, _NEVER_S
        elif started:
            self._deadline_s = self._limits.now_s() + HEADERS_S
        self._phase = phase
        self._mark(state)

    def _mark(self, state: State | None) -> None:
        if self._socket is not None:
            state = self._socket.state if state is None else state
            self._limits.mark(self._socket, state, min(self._deadline_s, self._read_by_s))


class RequestLimits:
    """Middleware: a limit for concurrent requests that does not apply to Stop, and a deadline for the response.

    Args:
        app: The application.
        limits: Counts the connections with a complete request.
        concurrent: Highest number of such connections.
    """

    def __init__(self, app: ASGIApp, *, limits: ConnectionLimits, concurrent: int) -> None:
        self._app = app
        self._limits = limits
        self._concurrent = concurrent

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See the ASGI specification."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limited = not is_stop(Request(scope))
        if limited and self._limits.active > self._concurrent:
            await problem(self._busy())(scope, receive, send)
            return
        loop = asyncio.get_running_loop()
        started = False

        async def receiving() -> Message:
            message = await receive()
            if limited and not started and self._limits.active > self._concurrent:
                raise self._busy()  # the body was incomplete at the check above
            if not started:
                timeout.reschedule(loop.time() + _HANDLER_S)
            return message

        async def sending(message: Message) -> None:
            nonlocal started
            started = True
            timeout.reschedule(None)
            await send(message)

        try:
            async with asyncio.timeout(_HANDLER_S) as timeout:
                await self._app(scope, receiving, sending)
        except TimeoutError:
            if started or not timeout.expired():
                raise
            detail = f"The server did not finish the request within {_HANDLER_S:.0f} s. Try again."
            await problem(Problem("busy", 503, "Busy", detail, retry_after_s=1))(scope, receive, send)
        if scope.get(AUTHENTICATED) and scope["client"]:
            self._limits.trust(scope["client"][0])

    def _busy(self) -> Problem:
        detail = f"The server processes {self._concurrent} requests. Stop is still accepted. Try again."
        return Problem("busy", 503, "Busy", detail, retry_after_s=1)
