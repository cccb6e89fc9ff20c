"""Starts the program at the controller, once per session and again after each stop of the robot itself."""

import contextlib
import socket
import threading
import time

from device_agent.drivers.ur import modes
from device_agent.drivers.ur.connection import Connection
from device_agent.ports.driver import UnreachableError
from device_agent.ports.threads import SupervisedThread

_TIMEOUT_S = 2.0
"""Time to connect, and from the upload to the program's first cycle [s]."""
_CHECK_S = 0.02


class ProgramStarter:
    """Uploads the program and watches it, in a thread of its own.

    After the robot has stopped itself and was released, the program is started again; it holds the robot. A program
    that was ended at the robot is not started again: the person at the robot decides.

    Args:
        address: Host and port of the secondary interface.
        script: The program.
        session: Its session.
        connection: Where the modes of the robot are read.
        device: Id of the device at its agent.
    """

    def __init__(
        self, address: tuple[str, int], script: str, *, session: int, connection: Connection, device: str
    ) -> None:
        self._address = address
        self._script = script.encode("ascii")
        self._session = session
        self._connection = connection
        self._stopping = threading.Event()
        self._settled = threading.Event()
        self._needed = True
        self._suspended = False
        self._error = ""
        self._thread = SupervisedThread(
            self._run, name=f"{device}-program", part="program starter of the driver", device=device
        )
        self._thread.start()

    def wait(self) -> None:
        """Return when the program runs, or when the robot cannot move at present.

        Raises:
            UnreachableError: The program does not start.
        """
        if not self._settled.wait(2 * _TIMEOUT_S):
            raise UnreachableError(self._error or f"{self._where} does not start the program")

    def suspend(self) -> None:
        """Do not start the program until ``resume``: another program moves the robot."""
        self._suspended = True

    def resume(self) -> None:
        """Start the program again."""
        self._needed = True
        self._suspended = False

    def close(self) -> None:
        """End the thread. May be called repeatedly."""
        self._stopping.set()
        self._thread.join(3 * _TIMEOUT_S)

    @property
    def _where(self) -> str:
        return f"{self._address[0]}:{self._address[1]}"

    def _run(self) -> None:
        while not self._stopping.wait(_CHECK_S):
            newest = self._connection.newest
            stopped = newest is not None and modes.fault(newest.safety_mode, newest.robot_mode) is not None
            if stopped:
                self._needed = True
                self._settled.set()
            if newest is not None and (stopped or newest.runtime_state == modes.PAUSED):
                with contextlib.suppress(UnreachableError):
                    self._connection.cancel()
            if self._needed and not stopped and not self._suspended:
                self._start()

    def _start(self) -> None:
        """Upload the program, and wait for its first cycle."""
        try:
            with socket.create_connection(self._address, timeout=_TIMEOUT_S) as uploading:
                uploading.sendall(self._script)
                # The controller streams its state here. Closing earlier would reset the connection with unread data,
                # and the controller might lose the program.
                end_s = time.monotonic() + _TIMEOUT_S
                while not self._stopping.wait(_CHECK_S) and time.monotonic() < end_s:
                    newest = self._connection.newest
                    if newest is not None and newest.runs(self._session):
                        self._needed = False
                        self._settled.set()
                        return
        except OSError as error:
            self._error = f"no connection to {self._where}: {error}"
            self._stopping.wait(_TIMEOUT_S / 4)
        else:
            self._error = f"{self._where} does not start the program; select remote control at the robot"
