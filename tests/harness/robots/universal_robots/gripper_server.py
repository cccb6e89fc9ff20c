"""The text protocol of a Robotiq gripper's URCap on loopback, from its published variables."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

_FULL = 255
_PER_S = 400.0
_CHECK_S = 0.05


class GripperServer:
    """One gripper; it starts open.

    Attributes:
        values: Values of ``SET``: ACT, GTO, POS.
        object_at: Position at which the fingers meet an object.
        active: Whether it is activated.
        garbled: Whether it answers with something else.
    """

    def __init__(self) -> None:
        self.values = {"ACT": 1, "GTO": 0, "POS": 0}
        self.object_at = _FULL
        self.active = True
        self.garbled = False
        self._position = 0.0
        self._at_s = time.monotonic()
        self._lock = threading.Lock()
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(_CHECK_S)
        self.port: int = self._server.getsockname()[1]
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def position(self) -> int:
        """Present position of the fingers, 0 to 255."""
        with self._lock:
            return self._advance()

    def close(self) -> None:
        """Switch it off."""
        self._closed.set()
        self._thread.join()
        self._server.close()

    def _advance(self) -> int:
        now_s = time.monotonic()
        target = min(self.values["POS"], self.object_at)
        step = _PER_S * (now_s - self._at_s) if self.values["GTO"] else 0.0
        self._position += min(max(target - self._position, -step), step)
        self._at_s = now_s
        return round(self._position)

    def _run(self) -> None:
        while not self._closed.is_set():
            with contextlib.suppress(OSError):
                client, _ = self._server.accept()
                client.settimeout(_CHECK_S)
                with client:
                    for line in self._lines(client):
                        client.sendall(self._respond(line).encode())

    def _lines(self, client: socket.socket) -> Iterator[str]:
        while not self._closed.is_set():
            try:
                received = client.recv(1024)
            except TimeoutError:
                continue
            if not received:
                return
            yield from received.decode().splitlines()

    def _respond(self, line: str) -> str:
        command, *words = line.split()
        with self._lock:
            position = self._advance()
            if self.garbled:
                return "?\n"
            if command == "SET":
                self.values.update({name: int(value) for name, value in zip(words[::2], words[1::2], strict=True)})
                return "ack"
            arrived = position == min(self.values["POS"], self.object_at)
            holds = arrived and self.object_at < self.values["POS"]
            answers = {
                "POS": position,
                "PRE": self.values["POS"],
                "STA": 3 if self.active else 0,
                "OBJ": 2 if holds else 3 if arrived else 0,
            }
            return f"{words[0]} {answers[words[0]]}\n"
