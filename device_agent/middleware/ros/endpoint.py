"""Options that state how ROS is reached, for drivers and sensors."""

import re
from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.middleware.ros.connection import Channel
from device_agent.middleware.ros.rosbridge import RosbridgeChannel
from device_agent.middleware.ros.rospy_channel import RospyChannel


class Endpoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How ROS is reached.

    Attributes:
        connection: Through a rosbridge server, or with ``rospy`` in a process of its own (ROS 1).
        address: Host and port of rosbridge, with ``wss://`` for an encrypted connection.
        certificate_authority: File with the certificates that ``wss://`` trusts; empty: those of the system.
        master: Address of the ROS master, for ``rospy``.
        python: Interpreter that has ``rospy``.
        python_folders: Folders of ROS's Python packages, if the interpreter does not find them.
        ros: Version of ROS: 1 or 2.
        simulated: Whether the device is a simulation, for example Gazebo. Operators see it.
    """

    connection: Literal["rosbridge", "rospy"] = "rosbridge"
    address: Annotated[str, Meta(pattern=r"^(wss?://)?[^:/\s]+(:[0-9]{1,5})?$")] = "127.0.0.1:9090"
    certificate_authority: str = ""
    master: Annotated[str, Meta(pattern=r"^http://[^:/\s]+:[0-9]{1,5}/?$")] = "http://127.0.0.1:11311"
    python: str = "/usr/bin/python3"
    python_folders: tuple[str, ...] = ()
    ros: Literal[1, 2] = 1
    simulated: bool = False

    @property
    def contradiction(self) -> str:
        """Options that contradict each other; empty if there are none."""
        if self.connection == "rospy" and self.ros != 1:
            return "option 'connection': use \"rosbridge\" with ROS 2"
        if self.certificate_authority and not self.address.startswith("wss://"):
            return "option 'certificate_authority' needs an address with wss://"
        return ""

    def open(self, device: str) -> Channel:
        """A new channel for one device.

        Raises:
            UnreachableError: There is no rosbridge server or no master.
        """
        if self.connection == "rosbridge":
            return RosbridgeChannel(self.address, certificate_authority=self.certificate_authority)
        node = "telescope_" + re.sub(r"\W", "_", device)
        return RospyChannel(python=self.python, folders=self.python_folders, master=self.master, node=node)
