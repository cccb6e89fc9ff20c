"""Driver of robots with ROS 1 or ROS 2. See ``docs/robots/ros.md``."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.ros import options as ros_options
from device_agent.drivers.ros.base_driver import RosBaseDriver
from device_agent.drivers.ros.driver import RosDriver
from device_agent.protocol.manifests.robot_type import RobotType

__all__ = ["RosBaseDriver", "RosDriver", "create"]


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> RosDriver:
    """The driver of one robot: the factory of ``drivers.load("ros")``. It opens no connection.

    Args:
        robot_type: The device's manifest.
        folder: The robot type's folder.
        options: See ``options.Options``.
        device: Id of the device at its agent.

    Raises:
        DriverError: An option is unknown, missing or wrong.
    """
    parsed = ros_options.parse(options, robot_type)
    if parsed.base is not None:
        return RosBaseDriver(robot_type, folder, parsed, parsed.base, device)
    return RosDriver(robot_type, folder, parsed, device)
