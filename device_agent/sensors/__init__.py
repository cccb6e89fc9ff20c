"""Drivers of room devices, one folder each, found by name.

Built-in drivers are listed with their import paths and imported on first use. Third parties register a ``Factory`` in
the entry point group ``telescope.sensors``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from device_agent.ports.plugins import PlugIns
from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.protocol.manifests.room import RoomDeviceManifest

__all__ = ["GROUP", "Factory", "load", "names"]

GROUP = "telescope.sensors"
_BUILT_IN: Mapping[str, str] = {
    "mjpeg": "device_agent.sensors.camera.mjpeg",
    "modbus": "device_agent.sensors.modbus",
    "mujoco": "device_agent.sensors.mujoco",
    "perception": "device_agent.sensors.perception",
    "ros": "device_agent.sensors.ros",
    "rtsp": "device_agent.sensors.camera.rtsp",
    "serial": "device_agent.sensors.serial",
    "tasmota": "device_agent.sensors.home_mqtt.tasmota",
    "v4l2": "device_agent.sensors.camera.v4l2",
    "zigbee2mqtt": "device_agent.sensors.home_mqtt.zigbee2mqtt",
}
"""Name → module that defines ``create``."""
_EXTRAS: Mapping[str, str] = {"modbus": "modbus", "serial": "serial"}
"""Name → extra of the agent's package with the libraries of the driver."""


class Factory(Protocol):
    """Creates the driver of one room device; ``RoomDriver.connect`` opens the hardware."""

    def __call__(self, device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:
        """The driver of one room device.

        Args:
            device: Its entry in the room's manifest, with its ``options``.
            folder: The room's folder; paths in the manifest are relative to it.
            surroundings: The agent's other room drivers, and the simulated world if there is one.

        Raises:
            SensorError: An option is unknown or has the wrong type; the message lists the valid ones.
        """


def names() -> tuple[str, ...]:
    """All names that ``load`` accepts, sorted."""
    return _PLUG_INS.names()


def load(name: str) -> Factory:
    """The factory of the driver with this name; built-in drivers take precedence over entry points.

    Raises:
        SensorError: Unknown driver, or a library that it needs is not installed.
    """
    return _PLUG_INS.load(name)


_PLUG_INS: PlugIns[Factory] = PlugIns(
    label="sensor driver", group=GROUP, built_in=_BUILT_IN, error=SensorError, extras=_EXTRAS
)
