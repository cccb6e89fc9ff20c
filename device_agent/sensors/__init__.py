"""Drivers of room devices, one folder each, found by name.

As with robots' drivers: built-in ones stand in a table of import paths and are imported when asked for; third parties
add theirs by the entry point group ``telescope.sensors``; the entry point is a ``Factory``.
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
    "mujoco": "device_agent.sensors.mujoco",
    "perception": "device_agent.sensors.perception",
}
"""Name → module that has ``create``."""


class Factory(Protocol):
    """Makes the driver of one room device. Opens nothing: that is ``RoomDriver.connect``."""

    def __call__(self, device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:
        """The driver of one room device.

        Args:
            device: Its entry in the room's manifest, with its ``options``.
            folder: The room's folder; paths in the manifest are relative to it.
            surroundings: The agent's other room drivers, and the simulated world where there is one.

        Raises:
            SensorError: An option is unknown or has the wrong type; the text lists the valid ones.
        """


def names() -> tuple[str, ...]:
    """All names that ``load`` takes, sorted."""
    return _KNOWN.names()


def load(name: str) -> Factory:
    """The factory of the driver with this name. A built-in driver wins over an entry point of the same name.

    Raises:
        SensorError: There is no such driver, or a library that it needs is not installed.
    """
    return _KNOWN.load(name)


_KNOWN: PlugIns[Factory] = PlugIns(what="sensor driver", group=GROUP, built_in=_BUILT_IN, error=SensorError)
