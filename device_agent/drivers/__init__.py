"""Robot drivers, one folder each, found by name.

Built-in drivers are listed with their import paths and imported on first use, so an agent needs only the libraries of
its own drivers. Third parties register a ``Factory`` in the entry point group ``telescope.drivers``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from device_agent.ports.driver import Driver, DriverError
from device_agent.ports.plugins import PlugIns
from device_agent.protocol.manifests.robot_type import RobotType

__all__ = ["GROUP", "Factory", "load", "names"]

GROUP = "telescope.drivers"
_BUILT_IN: Mapping[str, str] = {
    name: f"device_agent.drivers.{name}" for name in ("lerobot", "mujoco", "naoqi", "ros", "ur")
}
"""Name → module that defines ``create``."""


class Factory(Protocol):
    """Creates the driver of one device; ``Driver.connect`` opens the hardware."""

    def __call__(self, robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> Driver:
        """The driver of one device.

        Args:
            robot_type: The device's manifest.
            folder: The robot type's folder; paths in the manifest are relative to it.
            options: The ``[driver]`` section of the agent's configuration, without the driver's name.
            device: Id of the device at its agent.

        Raises:
            DriverError: An option is unknown or has the wrong type; the message lists the valid ones.
        """


def names() -> tuple[str, ...]:
    """All names that ``load`` accepts, sorted."""
    return _PLUG_INS.names()


def load(name: str) -> Factory:
    """The factory of the driver with this name; built-in drivers take precedence over entry points.

    Raises:
        DriverError: Unknown driver, or a library that it needs is not installed.
    """
    return _PLUG_INS.load(name)


_PLUG_INS: PlugIns[Factory] = PlugIns(label="driver", group=GROUP, built_in=_BUILT_IN, error=DriverError)
