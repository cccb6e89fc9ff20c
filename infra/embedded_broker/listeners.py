"""Transports of the broker: TCP sockets and WebSockets with one interface.

Both set TCP_NODELAY: with Nagle's algorithm a message waits up to 40 ms for the client's delayed acknowledgement of
the previous one.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Protocol, cast

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from function_app.entrypoints.hosts.connection_limits import ConnectionLimits

CLOSE_S = 1.0
"""Time for a client to read pending data before its connection closes [s]."""


class Transport(Protocol):
    """Output side of a client connection."""

    @property
    def unsent(self) -> int:
        """Bytes not yet passed to the kernel."""

    @property
    def congested(self) -> bool:
        """Whether the unsent data exceeds the limit for QoS 0 messages."""

    def admitted(self) -> None:
        """The client is authenticated: limits for other connections no longer apply."""

    def write(self, data: bytes) -> None:
        """Send data; never blocks; ignored after closing."""

    def close(self) -> None:
        """Close after sending pending data, or after ``CLOSE_S``."""

    def abort(self) -> None:
        """Close immediately."""


class Receiver(Protocol):
    """Callbacks of a transport."""

    def received(self, data: bytes) -> None:
        """Data has arrived."""

    def drained(self) -> None:
        """The transport is no longer congested."""

    def lost(self) -> None:
        """The transport has closed. Called once."""


Connected = Callable[[Transport], Receiver]


def disable_nagle(transport: asyncio.BaseTransport) -> None:
    """Set TCP_NODELAY."""
    transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _admit(limits: ConnectionLimits, transport: asyncio.BaseTransport) -> None:
    connection = limits.attach(transport)
    if connection is not None:
        limits.trust(connection.address)
        limits.release(connection)


class TcpTransport(asyncio.Protocol):
    """One accepted TCP socket."""

    def __init__(self, connected: Connected, limits: ConnectionLimits, *, congested_bytes: int) -> None:
        self._connected = connected
        self._limits = limits
        self._congested_bytes = congested_bytes
        self._receiver: Receiver | None = None
        self._transport: asyncio.Transport | None = None
        self.congested = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See ``asyncio.Protocol``."""
        self._transport = cast("asyncio.Transport", transport)
        disable_nagle(transport)
        self._limits.attach(transport)
        self._transport.set_write_buffer_limits(high=self._congested_bytes)
        self._receiver = self._connected(self)

    def data_received(self, data: bytes) -> None:
        """See ``asyncio.Protocol``."""
        if self._receiver is not None:
            self._receiver.received(data)

    def pause_writing(self) -> None:
        """See ``asyncio.Protocol``."""
        self.congested = True

    def resume_writing(self) -> None:
        """See ``asyncio.Protocol``."""
        self.congested = False
        if self._receiver is not None:
            self._receiver.drained()

    def connection_lost(self, exc: Exception | None) -> None:
        """See ``asyncio.Protocol``."""
        del exc
        receiver = self._receiver
        self._receiver = self._transport = None  # otherwise all remain until the next garbage collection
        if receiver is not None:
            receiver.lost()

    @property
    def unsent(self) -> int:
        """See ``Transport``."""
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    def admitted(self) -> None:
        """See ``Transport``."""
        if self._transport is not None:
            _admit(self._limits, self._transport)

    def write(self, data: bytes) -> None:
        """See ``Transport``."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(data)

    def close(self) -> None:
        """See ``Transport``."""
        if self._transport is not None:
            self._transport.close()
            asyncio.get_running_loop().call_later(CLOSE_S, self._transport.abort)

    def abort(self) -> None:
        """See ``Transport``."""
        if self._transport is not None:
            self._transport.abort()


class WebSocketTransport:
    """One accepted WebSocket. Packets written while a frame is being sent share the next frame."""

    def __init__(
        self, websocket: ServerConnection, connected: Connected, limits: ConnectionLimits, *, congested_bytes: int
    ) -> None:
        self._websocket = websocket
        self._limits = limits
        self._congested_bytes = congested_bytes
        self._pending: list[bytes] = []
        self._unsent = 0
        self._closing = False
        self._wake = asyncio.Event()
        disable_nagle(websocket.transport)
        limits.attach(websocket.transport)
        self._receiver = connected(self)

    async def serve(self) -> None:
        """Transfer data in both directions until either side closes."""
        writing = asyncio.create_task(self._write_all())
        try:
            async for message in self._websocket:
                if self._closing:
                    continue
                if isinstance(message, str):  # MQTT is binary frames only [MQTT-6.0.0-1]
                    break
                self._receiver.received(message)
        except ConnectionClosed:
            pass
        finally:
            writing.cancel()
            await asyncio.gather(writing, return_exceptions=True)
            self._receiver.lost()

    @property
    def unsent(self) -> int:
        """See ``Transport``."""
        return self._unsent

    @property
    def congested(self) -> bool:
        """See ``Transport``."""
        return self._unsent > self._congested_bytes

    def admitted(self) -> None:
        """See ``Transport``."""
        _admit(self._limits, self._websocket.transport)

    def write(self, data: bytes) -> None:
        """See ``Transport``."""
        if not self._closing:
            self._pending.append(data)
            self._unsent += len(data)
            self._wake.set()

    def close(self) -> None:
        """See ``Transport``."""
        self._closing = True
        self._wake.set()
        asyncio.get_running_loop().call_later(CLOSE_S, self._websocket.transport.abort)

    def abort(self) -> None:
        """See ``Transport``."""
        self._closing = True
        self._websocket.transport.abort()

    async def _write_all(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                await self._wake.wait()
                self._wake.clear()
                if self._pending:
                    data = b"".join(self._pending)
                    self._pending.clear()
                    await self._websocket.send(data)
                    was_congested = self.congested
                    self._unsent -= len(data)
                    if was_congested and not self.congested:
                        self._receiver.drained()
                if self._closing and not self._pending:
                    await self._websocket.close()
                    return
