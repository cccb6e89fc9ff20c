"""The two ways bytes come: a TCP socket, and a WebSocket. Above them there is no difference.

Both set TCP_NODELAY: with Nagle's algorithm a message that follows another waits for the client's delayed
acknowledgement, 40 ms (facts: latency).
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Protocol, cast

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

CLOSE_S = 1.0
"""How long a client may take to read what was written before its connection was closed [s]."""


class Link(Protocol):
    """The way back to one client."""

    @property
    def unsent(self) -> int:
        """Bytes that have not reached the kernel yet."""

    @property
    def congested(self) -> bool:
        """Whether more is unsent than a client that keeps up would leave."""

    def write(self, data: bytes) -> None:
        """Send; never blocks; nothing happens on a closed link."""

    def close(self) -> None:
        """Close once what was written has been sent, or after ``CLOSE_S``."""

    def abort(self) -> None:
        """Close now."""


class Receiver(Protocol):
    """What a link tells the connection on top of it."""

    def received(self, data: bytes) -> None:
        """Bytes have come."""

    def drained(self) -> None:
        """The link is no longer congested."""

    def lost(self) -> None:
        """The link is gone. Called once."""


Connected = Callable[[Link], Receiver]


def send_at_once(transport: asyncio.BaseTransport) -> None:
    """Switch off Nagle's algorithm."""
    transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class TcpLink(asyncio.Protocol):
    """One accepted TCP socket."""

    def __init__(self, connected: Connected, *, congested_bytes: int) -> None:
        self._connected = connected
        self._congested_bytes = congested_bytes
        self._receiver: Receiver | None = None
        self._transport: asyncio.Transport | None = None
        self.congested = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Called by the loop."""
        self._transport = cast("asyncio.Transport", transport)
        send_at_once(transport)
        self._transport.set_write_buffer_limits(high=self._congested_bytes)
        self._receiver = self._connected(self)

    def data_received(self, data: bytes) -> None:
        """Called by the loop."""
        if self._receiver is not None:
            self._receiver.received(data)

    def pause_writing(self) -> None:
        """Called by the loop."""
        self.congested = True

    def resume_writing(self) -> None:
        """Called by the loop."""
        self.congested = False
        if self._receiver is not None:
            self._receiver.drained()

    def connection_lost(self, exc: Exception | None) -> None:
        """Called by the loop."""
        del exc
        if self._receiver is not None:
            self._receiver.lost()

    @property
    def unsent(self) -> int:
        """As ``Link`` says."""
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    def write(self, data: bytes) -> None:
        """As ``Link`` says."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(data)

    def close(self) -> None:
        """As ``Link`` says."""
        if self._transport is not None:
            self._transport.close()
            asyncio.get_running_loop().call_later(CLOSE_S, self._transport.abort)

    def abort(self) -> None:
        """As ``Link`` says."""
        if self._transport is not None:
            self._transport.abort()


class WebSocketLink:
    """One accepted WebSocket. Packets that are written while a frame is on its way share the next one."""

    def __init__(self, websocket: ServerConnection, connected: Connected, *, congested_bytes: int) -> None:
        self._websocket = websocket
        self._congested_bytes = congested_bytes
        self._waiting: list[bytes] = []
        self._unsent = 0
        self._closing = False
        self._wake = asyncio.Event()
        send_at_once(websocket.transport)
        self._receiver = connected(self)

    async def serve(self) -> None:
        """Carry bytes both ways until either side ends it."""
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
        """As ``Link`` says."""
        return self._unsent

    @property
    def congested(self) -> bool:
        """As ``Link`` says."""
        return self._unsent > self._congested_bytes

    def write(self, data: bytes) -> None:
        """As ``Link`` says."""
        if not self._closing:
            self._waiting.append(data)
            self._unsent += len(data)
            self._wake.set()

    def close(self) -> None:
        """As ``Link`` says."""
        self._closing = True
        self._wake.set()
        asyncio.get_running_loop().call_later(CLOSE_S, self._websocket.transport.abort)

    def abort(self) -> None:
        """As ``Link`` says."""
        self._closing = True
        self._websocket.transport.abort()

    async def _write_all(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                await self._wake.wait()
                self._wake.clear()
                if self._waiting:
                    data = b"".join(self._waiting)
                    self._waiting.clear()
                    await self._websocket.send(data)
                    was_congested = self.congested
                    self._unsent -= len(data)
                    if was_congested and not self.congested:
                        self._receiver.drained()
                if self._closing and not self._waiting:
                    await self._websocket.close()
                    return
