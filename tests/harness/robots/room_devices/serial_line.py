"""Serial ports without hardware: a pseudo terminal whose other end the test writes, and a cable between two of them."""

import contextlib
import os
import pty
import select
import threading
import tty
from typing import Self


class SerialLine:
    """A serial port at ``path``; a context manager that unplugs it."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)

    def write(self, data: bytes) -> None:
        """Send bytes to the program that reads the port."""
        while data:
            data = data[os.write(self.master, data) :]

    def unplug(self) -> None:
        """Remove the port: reads of it fail, and it cannot be opened again. May be called repeatedly."""
        for end in (self._slave, self.master):
            with contextlib.suppress(OSError):
                os.close(end)
        self._slave = self.master = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()


class SerialCable:
    """Two serial ports that are connected; a context manager that unplugs them."""

    def __init__(self) -> None:
        self.near, self.far = SerialLine(), SerialLine()
        self._stop_reader, self._stop_writer = os.pipe()
        self._thread = threading.Thread(target=self._copy, daemon=True)
        self._thread.start()

    def _copy(self) -> None:
        other = {self.near.master: self.far.master, self.far.master: self.near.master}
        while True:
            ready, _, _ = select.select([*other, self._stop_reader], [], [])
            if self._stop_reader in ready:
                return
            for end in ready:
                os.write(other[end], os.read(end, 4096))

    def unplug(self) -> None:
        if self._thread.is_alive():
            os.write(self._stop_writer, b"!")
            self._thread.join()
        self.near.unplug()
        self.far.unplug()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()
        os.close(self._stop_reader)
        os.close(self._stop_writer)
