"""paho inside an event loop, without a thread of its own: its socket is read and written when the loop says so."""

import asyncio
import socket
import ssl
from typing import Any

import paho.mqtt.client as mqtt

from function_app.ports.command_bus import BusUnavailable

_IDLE_TURNS = 2
"""Turns of the event loop with nothing to read; before the first it may have looked without this reader."""


def prepare(client: mqtt.Client) -> None:
    """To be called before the client connects, inside the loop that it is to live in."""
    loop = asyncio.get_running_loop()

    def opened(_client: mqtt.Client, _data: Any, sock: Any) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def closing(_client: mqtt.Client, _data: Any, sock: Any) -> None:
        # The last moment at which the event loop can still be told to forget it.
        loop.remove_reader(sock)
        loop.remove_writer(sock)

    client.on_socket_open = opened
    client.on_socket_close = closing


def listen(client: mqtt.Client, *, every_s: float = 0.0) -> None:
    """Read the packets of a connected client: each at once, or with ``every_s`` [s] in rounds.

    Raises:
        BusUnavailable: The client is not connected any more.
    """
    sock = client.socket()
    if sock is None:
        raise BusUnavailable("the broker closed the connection")
    if every_s:
        _Unhurried(client, sock, every_s).sleep()
    else:
        asyncio.get_running_loop().add_reader(sock, _read, client)


class _Unhurried:
    """Reads periodically. Waking for each message would take processor time from commands and responses."""

    def __init__(self, client: mqtt.Client, sock: Any, every_s: float) -> None:
        self._client = client
        self._sock = sock
        self._every_s = every_s
        self._loop = asyncio.get_running_loop()
        self._some = False
        self._idle_turns = 0

    def sleep(self) -> None:
        """Wait until something comes, however long."""
        self._loop.add_reader(self._sock, self._wake)

    def _wake(self) -> None:
        self._loop.remove_reader(self._sock)
        self._loop.call_later(self._every_s, self._begin)

    def _begin(self) -> None:
        if self._current:
            self._some, self._idle_turns = False, 0
            self._loop.add_reader(self._sock, self._read)
            self._loop.call_soon(self._go_on)

    @property
    def _current(self) -> bool:
        """Whether the client has not been dropped meanwhile."""
        now: Any = self._client.socket()
        return now is self._sock and now.fileno() >= 0

    def _read(self) -> None:
        self._some, self._idle_turns = True, 0
        _read(self._client)

    def _go_on(self) -> None:
        """Once a turn of the loop, until there is nothing more to read."""
        if not self._current:
            return
        self._idle_turns += 1
        if self._idle_turns <= _IDLE_TURNS:
            self._loop.call_soon(self._go_on)
            return
        self._loop.remove_reader(self._sock)
        if self._some:
            self._loop.call_later(self._every_s, self._begin)
        else:
            self.sleep()


def flush(client: mqtt.Client) -> None:
    """What did not fit into the socket goes out as soon as it does."""
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
    # paho closes the socket only once the broker has; the connection is ours to close.
    sock.close()


def _read(client: mqtt.Client) -> None:
    client.loop_read()
    # With TLS a message may have been decrypted with the one before it: then the socket has nothing more to tell.
    while isinstance(sock := client.socket(), ssl.SSLSocket) and sock.pending():
        client.loop_read()
    flush(client)


def _write(client: mqtt.Client, sock: Any) -> None:
    client.loop_write()
    if client.socket() is not None and not client.want_write():
        asyncio.get_running_loop().remove_writer(sock)
