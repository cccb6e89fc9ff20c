"""The perception sensor: fuses the data of the agent's other room devices."""

from pathlib import Path

from device_agent.ports.sensor import Surroundings
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.perception.driver import PerceptionDriver

__all__ = ["PerceptionDriver", "create"]


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> PerceptionDriver:
    """The driver of one device: the factory of ``sensors.load("perception")``.

    Raises:
        SensorError: An option is unknown or has the wrong type.
    """
    return PerceptionDriver(device, folder, surroundings.neighbours)
