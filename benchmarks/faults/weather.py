"""A link that is slow or loses packets, between a client and a server on this machine: a proxy in user space."""

import contextlib
import queue
import random
import socket
import threading
import time

HOST = "127.0.0.1"
STALL_S = 0.2
"""What TCP waits at least before it sends a lost packet again (Linux); all that follows waits too."""


class Weather:
    """Passes bytes both ways, in order.

    Attributes:
        port: Where clients connect.
        delay_s: What each way takes.
        loss: Share of packets that are lost once: they, and all behind them, come ``STALL_S`` later.
    """

    def __init__(self, behind: int, *, seed: int = 1) -> None:
        self.delay_s = 0.0
        self.loss = 0.0
        self._behind = behind
        self._chance = random.Random(seed)
        self._listener = socket.create_server((HOST, 0))
        self.port: int = self._listener.getsockname()[1]
        self._opened: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def end(self) -> None:
        """Close everything."""
        for each in (self._listener, *self._opened):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                try:
                    server = socket.create_connection((HOST, self._behind))
                except OSError:
                    client.close()
                    continue
                self._opened = [each for each in self._opened if each.fileno() >= 0] + [client, server]
                for one, other in ((client, server), (server, client)):
                    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    threading.Thread(target=self._carry, args=(one, other), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        way: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        threading.Thread(target=_deliver, args=(way, sink), daemon=True).start()
        content = b"."
        while content:
            try:
                content = source.recv(65_536)
            except OSError:
                content = b""
            lost = self._chance.random() < self.loss
            way.put((time.monotonic() + self.delay_s + (STALL_S if lost else 0.0), content))


def _deliver(way: "queue.SimpleQueue[tuple[float, bytes]]", sink: socket.socket) -> None:
    """In order, each when it is due; nothing is the end of the connection."""
    with contextlib.suppress(OSError):
        while True:
            due_s, content = way.get()
            time.sleep(max(0.0, due_s - time.monotonic()))
            if not content:
                break
            sink.sendall(content)
    with contextlib.suppress(OSError):
        sink.shutdown(socket.SHUT_RDWR)
    sink.close()
