"""A TLS connection with the calls of a plain socket that does not block."""

import contextlib
import socket
import ssl
import threading


class TlsSocket:
    """A connected TLS socket for one receiving thread and any number of sending threads.

    OpenSSL allows one call at a time for a connection, so calls are locked. None of them waits for the network.

    Args:
        connected: The socket after its handshake. It does not block.
    """

    def __init__(self, connected: ssl.SSLSocket) -> None:
        self._socket = connected
        self._lock = threading.Lock()

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()

    def send(self, data: bytes, flags: int = 0) -> int:
        """Send without waiting. Returns how many bytes the network has taken.

        Raises:
            OSError: The connection is lost.
        """
        del flags  # the socket never blocks
        sent = 0
        with self._lock, contextlib.suppress(ssl.SSLWantWriteError, ssl.SSLWantReadError):
            while sent < len(data):  # one call sends at most one record
                sent += self._socket.send(data[sent:])
        return sent

    def recv(self, size: int) -> bytes:
        """What has arrived; empty after the end. ``select`` does not see what the library has read already.

        Raises:
            BlockingIOError: Nothing has arrived.
            OSError: The connection is lost.
        """
        parts = []
        with self._lock:
            try:
                parts.append(self._socket.recv(size))
                while self._socket.pending():
                    parts.append(self._socket.recv(size))
            except (ssl.SSLWantReadError, ssl.SSLWantWriteError) as error:
                if not parts:
                    raise BlockingIOError from error
        return b"".join(parts)

    def setsockopt(self, level: int, option: int, value: bytes) -> None:
        """Set an option of the socket."""
        self._socket.setsockopt(level, option, value)

    def shutdown(self, how: int) -> None:
        """End the connection at once; calls of other threads then fail."""
        socket.socket.shutdown(self._socket, how)

    def close(self) -> None:
        """Free the socket."""
        self._socket.close()
