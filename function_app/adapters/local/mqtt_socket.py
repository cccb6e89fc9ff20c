"""paho inside an event loop, without a thread of its own: its socket is read and written when the loop says so."""

import asyncio
import socket
import ssl
from typing import Any

import paho.mqtt.client as mqtt

from function_app.ports.command_bus import BusUnavailable


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


def listen(client: mqtt.Client) -> None:
    """Read what comes, once it has connected.

    Raises:
        BusUnavailable: It is connected no longer.
    """
    sock = client.socket()
    if sock is None:
        raise BusUnavailable("the broker closed the connection")
    asyncio.get_running_loop().add_reader(sock, _read, client)


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
