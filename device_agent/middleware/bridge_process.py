"""Process that runs a library of a robot with its own Python, connected by a socket with one message a line."""

import contextlib
import select
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path

from device_agent.ports.driver import UnreachableError

_END_S = 2.0
_CHECK_S = 0.1
_MAX_LINE = 8 << 20


class BridgeProcess:
    """A started bridge. Its standard input is the socket; when that closes, it stops the robot and ends.

    Args:
        name: Name of the bridge in messages: ``NAOqi bridge``.
        python: Interpreter that has the library.
        program: The bridge; it imports nothing of the agent.
        arguments: Its arguments.

    Raises:
        UnreachableError: The interpreter cannot be started.
    """

    def __init__(self, name: str, python: str, program: Path, *arguments: str) -> None:
        self._name = name
        self._parts: list[bytes] = []
        self._link, theirs = socket.socketpair()
        try:
            # A new session, so that Ctrl-C in a terminal does not end the bridge before it has stopped the robot.
            self.process = subprocess.Popen(  # noqa: S603 (the interpreter is named in the local configuration)
                [python, "-I", str(program), *arguments], stdin=theirs.fileno(), start_new_session=True
            )
        except OSError as error:
            self._link.close()
            raise UnreachableError(f"the Python of the {name} cannot be started: {error}") from error
        finally:
            theirs.close()

    def send(self, message: bytes) -> None:
        """Send one message. Never blocks. After an error the connection is closed.

        Raises:
            ConnectionError: The bridge has ended or hangs.
        """
        try:
            sent = self._link.send(message + b"\n", socket.MSG_DONTWAIT)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise self._ended() from error
        if sent <= len(message):
            self.disconnect()
            raise ConnectionError(f"the {self._name} hangs")

    def receive(self) -> Sequence[bytes]:
        """Messages that have arrived, after at most 0.1 s. Only one thread may call it.

        Raises:
            ConnectionError: The bridge has ended, or the connection was closed.
        """
        try:
            if not select.select([self._link], [], [], _CHECK_S)[0]:
                return ()
            received = self._link.recv(1 << 16)
        except (OSError, ValueError) as error:
            raise self._ended() from error
        if not received or sum(map(len, self._parts)) > _MAX_LINE:
            raise self._ended()
        self._parts.append(received)
        if b"\n" not in received:
            return ()  # a part of a long message is not searched again
        *lines, rest = b"".join(self._parts).split(b"\n")
        self._parts = [rest]
        return lines

    def disconnect(self) -> None:
        """Close the connection. Any thread may call it."""
        with contextlib.suppress(OSError):
            self._link.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End the bridge, which stops the robot. May be called repeatedly; not while another thread receives."""
        self.disconnect()
        self._link.close()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def _ended(self) -> ConnectionError:
        return ConnectionError(f"the {self._name} has ended")
