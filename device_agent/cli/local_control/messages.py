"""Messages of the control socket: one JSON line each way, then the connection ends."""

import os
import socket
import sys
from pathlib import Path
from typing import Literal

from msgspec import Struct

SOCKET_FILE = "control.sock"
MAX_BYTES = 4096
TIMEOUT_S = 5.0
"""Time for one request and its response [s]."""


class ControlRequest(Struct, frozen=True, kw_only=True):
    """A request to the running agent.

    Attributes:
        kind: ``status``: nothing changes. ``request-restart``: reject motion for a short time if all devices are at
            rest. ``confirm-restart``: end now. ``cancel-restart``: allow motion again.
        token: The permission; for ``confirm-restart`` and ``cancel-restart``.
    """

    kind: Literal["status", "request-restart", "confirm-restart", "cancel-restart"]
    token: str = ""


class ControlResponse(Struct, frozen=True, kw_only=True):
    """The agent's response.

    Attributes:
        ok: Whether the request was carried out.
        version: Version of the running release.
        linked: Whether the link to the cloud is up.
        token: The permission that was given.
        reason: Why the request was rejected.
    """

    ok: bool
    version: str
    linked: bool = False
    token: str = ""
    reason: str = ""


class SocketAddress:
    """Address of the control socket in a folder; a context manager, because a long path needs an open descriptor.

    The path of a Unix socket has at most 107 bytes, so on Linux the folder is named by its descriptor.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._descriptor = -1

    def __enter__(self) -> str:
        if sys.platform != "linux":
            return str(self._folder / SOCKET_FILE)
        self._descriptor = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        return f"/proc/self/fd/{self._descriptor}/{SOCKET_FILE}"

    def __exit__(self, *_: object) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)


def receive_line(connection: socket.socket) -> bytes:
    """The first line that arrives, at most ``MAX_BYTES``; shorter if the peer closes the connection.

    Raises:
        OSError: The connection failed, or nothing arrived in time.
    """
    received = b""
    while b"\n" not in received and len(received) < MAX_BYTES:
        part = connection.recv(MAX_BYTES)
        if not part:
            break
        received += part
    return received.partition(b"\n")[0]
