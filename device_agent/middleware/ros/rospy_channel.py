"""Channel to ROS 1 through the bridge process ``rospy_bridge.py``: JSON messages, one a line."""

import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from device_agent.middleware.bridge_process import BridgeProcess
from device_agent.ports.driver import UnreachableError

_START_S = 6.0
"""Time until the node is registered [s]; it includes the start of the bridge's Python."""
_BRIDGE = Path(__file__).with_name("rospy_bridge.py")


class _Status(msgspec.Struct, frozen=True, tag="status", tag_field="op"):
    level: str
    msg: str


class RospyChannel(BridgeProcess):
    """A started bridge process whose node is registered. See ``Channel``.

    Args:
        python: Interpreter that has the package ``rospy``.
        folders: Folders of ROS's Python packages; empty if the interpreter finds them.
        master: Address of the ROS master: ``http://robot:11311``.
        node: Name of the node; ROS appends a number.
        needs_subscribers: Whether the channel is lost when a topic that it publishes has no subscriber. Commands
            of a robot need one.

    Raises:
        UnreachableError: The bridge cannot be started, or there is no master.
    """

    def __init__(
        self, *, python: str, folders: Sequence[str], master: str, node: str, needs_subscribers: bool = True
    ) -> None:
        self.where = f"ROS at {master}"
        super().__init__("ROS bridge", python, _BRIDGE, node, master, "1" if needs_subscribers else "", *folders)
        try:
            self._wait_until_ready()
        except (OSError, msgspec.MsgspecError) as error:
            self.close()
            raise UnreachableError(f"{self.where}: {error}") from error

    def _wait_until_ready(self) -> None:
        end_s = time.monotonic() + _START_S
        while time.monotonic() < end_s:
            for line in self.receive():
                status = msgspec.json.decode(line, type=_Status)
                if status.level == "error":
                    raise ConnectionError(status.msg)
                return
        raise TimeoutError("the ROS bridge does not start")
