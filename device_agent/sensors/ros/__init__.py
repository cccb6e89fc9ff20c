"""Sensors of a room over ROS. See ``docs/robots/ros.md``."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.ros import options
from device_agent.sensors.ros.base import RosSensor
from device_agent.sensors.ros.cameras import ColourCamera, CompressedCamera, DepthCamera
from device_agent.sensors.ros.ranges import Lidar, PointCloud

__all__ = ["KINDS", "create"]

KINDS: Mapping[str, type[RosSensor]] = {
    "camera": ColourCamera,
    "compressed_camera": CompressedCamera,
    "depth_camera": DepthCamera,
    "lidar": Lidar,
    "point_cloud": PointCloud,
}
"""``kind`` of the manifest → driver class."""


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:
    """The driver of one device: the factory of ``sensors.load("ros")``. It opens no connection.

    Raises:
        SensorError: Unknown kind, or an option is unknown, missing or wrong.
    """
    del folder, surroundings
    if device.kind not in KINDS:
        raise SensorError(f"driver 'ros' has no kind '{device.kind}'; it has: {', '.join(KINDS)}")
    return KINDS[device.kind](device, options.parse(device))
