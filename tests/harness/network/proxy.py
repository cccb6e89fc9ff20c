"""A TCP proxy whose connections a test can cut, with or without notice to the peers.

with start_proxy(broker.tcp_port) as proxy:
    connect(proxy.port)
    proxy.swallow()
"""

import contextlib
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterator

HOST = "127.0.0.1"


class Proxy:
    """Forwards data in both directions.

    Args:
        behind: Port of the server.
        on_data: Called with data for clients before it is forwarded.

    Attributes:
        port: Port for clients.
        accepted: Number of accepted connections.
        arrivals: Data since ``acknowledge_late``: time [s], whether from the server, content.
    """

    def __init__(self, behind: int, on_data: Callable[[bytes], None] | None = None) -> None:
        self.accepted = 0
        self.arrivals: list[tuple[float, bool, bytes]] = []
        self._late = False
        self._on_data = on_data
        self._frozen = False
        self._behind = behind
        self._listener = socket.create_server((HOST, 0))
        self.port: int = self._listener.getsockname()[1]
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._wake, self._woken = socket.socketpair()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._peers: dict[socket.socket, socket.socket] = {}
        self._servers: set[socket.socket] = set()
        self._swallowed: list[socket.socket] = []
        self._lock = threading.Lock()
        self._ended = False
        self._refuses = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def freeze(self) -> None:
        """Stop forwarding without closing; data is queued until ``thaw``, as on a stalled link."""
        with self._lock:
            self._frozen = True
            for each in (self._listener, *self._peers):
                self._selector.unregister(each)

    def thaw(self) -> None:
        """Forward again, including queued data."""
        with self._lock:
            self._frozen = False
            for each in (self._listener, *self._peers):
                self._selector.register(each, selectors.EVENT_READ)

    def swallow(self) -> None:
        """Drop all traffic of the current connections silently, like a router that lost its state."""
        with self._lock:
            for each in self._peers:
                self._selector.unregister(each)
            self._swallowed.extend(self._peers)
            self._peers.clear()
            self._servers.clear()

    def cut(self) -> None:
        """Close the current connections."""
        with self._lock:
            for each in self._peers:
                self._selector.unregister(each)
                each.close()
            self._peers.clear()
            self._servers.clear()

    def refuse(self) -> None:
        """Close all current and future connections."""
        self._refuses = True
        self.cut()

    def admit(self) -> None:
        """Accept connections again."""
        self._refuses = False

    def acknowledge_late(self) -> None:
        """Delay TCP acknowledgements by up to 40 ms, as a kernel may; reveals a missing TCP_NODELAY."""
        with self._lock:
            self._late = True
            for each in self._peers:
                _acknowledge_late(each)

    def end(self) -> None:
        if self._frozen:
            self.thaw()
        self._ended = True
        self._wake.send(b"x")
        self._thread.join()
        self.cut()
        for each in (*self._swallowed, self._listener, self._wake, self._woken):
            each.close()
        self._selector.close()

    def _run(self) -> None:
        while not self._ended:
            for key, _ in self._selector.select():
                with self._lock:
                    self._handle(key.fileobj)

    def _handle(self, ready: object) -> None:
        if self._frozen:
            return
        if ready is self._listener:
            self._accept()
        elif isinstance(ready, socket.socket) and ready in self._peers:
            self._forward(ready, self._peers[ready])

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        self.accepted += 1
        if self._refuses:
            client.close()
            return
        try:
            server = socket.create_connection((HOST, self._behind))
        except OSError:
            client.close()
            return
        self._servers.add(server)
        for one, other in ((client, server), (server, client)):
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._late:
                _acknowledge_late(one)
            self._peers[one] = other
            self._selector.register(one, selectors.EVENT_READ)

    def _forward(self, ready: socket.socket, other: socket.socket) -> None:
        content = b""
        with contextlib.suppress(OSError):
            content = ready.recv(65_536)
        if content:
            if self._late:
                self.arrivals.append((time.perf_counter(), ready in self._servers, content))
                _acknowledge_late(ready)
            if self._on_data is not None and ready in self._servers:
                self._on_data(content)
            with contextlib.suppress(OSError):
                other.sendall(content)
            return
        for each in (ready, other):
            self._selector.unregister(each)
            del self._peers[each]
            self._servers.discard(each)
            each.close()


def _acknowledge_late(one: socket.socket) -> None:
    """Must be set again after each read."""
    with contextlib.suppress(OSError):  # already closed
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 0)


@contextlib.contextmanager
def start_proxy(behind: int, on_data: Callable[[bytes], None] | None = None) -> Iterator[Proxy]:
    """A proxy in front of a local port."""
    proxy = Proxy(behind, on_data)
    try:
        yield proxy
    finally:
        proxy.end()
