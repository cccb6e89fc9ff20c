"""Runs a paho client in an asyncio event loop instead of a thread."""

import asyncio
import socket
import ssl
from typing import Any

import paho.mqtt.client as mqtt

from function_app.ports.command_bus import BusUnavailable

_IDLE_ITERATIONS = 2
"""Loop iterations without data until the socket is considered empty; the first may precede the new reader."""


def prepare(client: mqtt.Client) -> None:
    """Set up a client before it connects. Call it in the client's event loop."""
    loop = asyncio.get_running_loop()

    def opened(_client: mqtt.Client, _data: Any, sock: Any) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def closing(_client: mqtt.Client, _data: Any, sock: Any) -> None:
        # The event loop cannot remove a closed socket.
        loop.remove_reader(sock)
        loop.remove_writer(sock)

    client.on_socket_open = opened
    client.on_socket_close = closing


def listen(client: mqtt.Client, *, every_s: float = 0.0) -> None:
    """Read the packets of a connected client: immediately, or periodically with ``every_s`` [s].

    Raises:
        BusUnavailable: The client is no longer connected.
    """
    sock = client.socket()
    if sock is None:
        raise BusUnavailable("the broker closed the connection")
    if every_s:
        _PeriodicReader(client, sock, every_s).wait()
    else:
        asyncio.get_running_loop().add_reader(sock, _read, client)


class _PeriodicReader:
    """Reads periodically. Waking for each message would take processor time from commands and responses."""

    def __init__(self, client: mqtt.Client, sock: Any, every_s: float) -> None:
        self._client = client
        self._sock = sock
        self._every_s = every_s
        self._loop = asyncio.get_running_loop()
        self._received = False
        self._idle_iterations = 0

    def wait(self) -> None:
        """Wait for data without a timer."""
        self._loop.add_reader(self._sock, self._wake)

    def _wake(self) -> None:
        self._loop.remove_reader(self._sock)
        self._loop.call_later(self._every_s, self._start_reading)

    def _start_reading(self) -> None:
        if self._is_current:
            self._received, self._idle_iterations = False, 0
            self._loop.add_reader(self._sock, self._read)
            self._loop.call_soon(self._continue_reading)

    @property
    def _is_current(self) -> bool:
        """Whether the client still uses this socket."""
        current: Any = self._client.socket()
        return current is self._sock and current.fileno() >= 0

    def _read(self) -> None:
        self._received, self._idle_iterations = True, 0
        _read(self._client)

    def _continue_reading(self) -> None:
        """Runs in each loop iteration until the socket is empty."""
        if not self._is_current:
            return
        self._idle_iterations += 1
        if self._idle_iterations <= _IDLE_ITERATIONS:
            self._loop.call_soon(self._continue_reading)
            return
        self._loop.remove_reader(self._sock)
        if self._received:
            self._loop.call_later(self._every_s, self._start_reading)
        else:
            self.wait()


def flush(client: mqtt.Client) -> None:
    """Send buffered data when the socket becomes writable."""
    sock = client.socket()
    if sock is not None and client.want_write():
        asyncio.get_running_loop().add_writer(sock, _write, client, sock)


def drop(client: mqtt.Client) -> None:
    """Disconnect, and close the socket."""
    sock = client.socket()
    if sock is None:
        return
    loop = asyncio.get_running_loop()
    loop.remove_reader(sock)
    loop.remove_writer(sock)
    client.disconnect()
    client.loop_write()
    # paho closes the socket only after the broker has closed it.
    sock.close()


def _read(client: mqtt.Client) -> None:
    client.loop_read()
    # With TLS, several messages may be decrypted at the same time; then the socket signals no further data.
    while isinstance(sock := client.socket(), ssl.SSLSocket) and sock.pending():
        client.loop_read()
    flush(client)


def _write(client: mqtt.Client, sock: Any) -> None:
    client.loop_write()
    if client.socket() is not None and not client.want_write():
        asyncio.get_running_loop().remove_writer(sock)
