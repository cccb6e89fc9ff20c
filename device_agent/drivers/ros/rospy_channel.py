"""Channel to ROS 1 through the bridge process ``rospy_bridge.py``: JSON messages, one a line."""

import contextlib
import select
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from device_agent.ports.driver import UnreachableError

_START_S = 6.0
"""Time until the node is registered [s]; it includes the start of the bridge's Python."""
_END_S = 2.0
_CHECK_S = 0.1
_MAX_LINE = 1 << 20
_BRIDGE = Path(__file__).with_name("rospy_bridge.py")


class _Status(msgspec.Struct, frozen=True, tag="status", tag_field="op"):
    level: str
    msg: str


class RospyChannel:
    """A started bridge process whose node is registered. See ``Channel``.

    Args:
        python: Interpreter that has the package ``rospy``.
        folders: Folders of ROS's Python packages; empty if the interpreter finds them.
        master: Address of the ROS master: ``http://robot:11311``.
        node: Name of the node; ROS appends a number.

    Raises:
        UnreachableError: The bridge cannot be started, or there is no master.
    """

    def __init__(self, *, python: str, folders: Sequence[str], master: str, node: str) -> None:
        self.where = f"ROS at {master}"
        self._buffer = b""
        self._link, theirs = socket.socketpair()
        try:
            # A new session, so that Ctrl-C in a terminal does not end the bridge before the base brakes.
            self._process = subprocess.Popen(  # noqa: S603 (the interpreter is named in the local configuration)
                [python, "-I", str(_BRIDGE), node, master, *folders], stdin=theirs.fileno(), start_new_session=True
            )
        except OSError as error:
            self._link.close()
            raise UnreachableError(f"the Python of the ROS bridge cannot be started: {error}") from error
        finally:
            theirs.close()
        try:
            self._wait_until_ready()
        except (OSError, msgspec.MsgspecError) as error:
            self.close()
            raise UnreachableError(f"{self.where}: {error}") from error

    def send(self, message: bytes) -> None:
        """See ``Channel``."""
        if self._link.send(message + b"\n", socket.MSG_DONTWAIT) < len(message) + 1:
            self.disconnect()
            raise ConnectionError("the ROS bridge hangs")

    def receive(self) -> Sequence[bytes]:
        """See ``Channel``."""
        try:
            if not select.select([self._link], [], [], _CHECK_S)[0]:
                return ()
        except ValueError as error:
            raise ConnectionError("the connection was closed") from error
        received = self._link.recv(1 << 16)
        if not received or len(self._buffer) > _MAX_LINE:
            raise ConnectionError("the ROS bridge has ended")
        *lines, self._buffer = (self._buffer + received).split(b"\n")
        return lines

    def disconnect(self) -> None:
        """See ``Channel``."""
        with contextlib.suppress(OSError):
            self._link.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """See ``Channel``; ends the bridge, which brakes a base."""
        self.disconnect()
        self._link.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait_until_ready(self) -> None:
        end_s = time.monotonic() + _START_S
        while time.monotonic() < end_s:
            for line in self.receive():
                status = msgspec.json.decode(line, type=_Status)
                if status.level == "error":
                    raise ConnectionError(status.msg)
                return
        raise TimeoutError("the ROS bridge does not start")
