"""Drivers, one folder each, found by name.

Built-in drivers stand in a table of import paths and are imported when asked for, so an agent needs only the libraries
of the drivers it uses. Third parties add theirs by the entry point group ``telescope.drivers``; the entry point is a
``Factory``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from device_agent.ports.driver import Driver, DriverError
from device_agent.ports.plugins import PlugIns
from device_agent.protocol.manifests.robot_type import RobotType

__all__ = ["GROUP", "Factory", "load", "names"]

GROUP = "telescope.drivers"
_BUILT_IN: Mapping[str, str] = {"mujoco": "device_agent.drivers.mujoco"}
"""Name → module that has ``create``."""


class Factory(Protocol):
    """Makes the driver of one device. Opens nothing: that is ``Driver.connect``."""

    def __call__(self, robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> Driver:
        """The driver of one device.

        Args:
            robot_type: The device's manifest.
            folder: The robot type's folder; paths in the manifest are relative to it.
            options: The ``[driver]`` part of the agent's configuration, without the driver's name.
            device: Id of the device at its agent.

        Raises:
            DriverError: An option is unknown or has the wrong type; the text lists the valid ones.
        """


def names() -> tuple[str, ...]:
    """All names that ``load`` takes, sorted."""
    return _KNOWN.names()


def load(name: str) -> Factory:
    """The factory of the driver with this name. A built-in driver wins over an entry point of the same name.

    Raises:
        DriverError: There is no such driver, or a library that it needs is not installed.
    """
    return _KNOWN.load(name)


_KNOWN: PlugIns[Factory] = PlugIns(what="driver", group=GROUP, built_in=_BUILT_IN, error=DriverError)
