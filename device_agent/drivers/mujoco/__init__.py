"""Robots in a MuJoCo simulation, in real time. Needs no display: nothing here draws."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.drivers.mujoco.snapshot import Snapshot
from device_agent.drivers.mujoco.twin import draw
from device_agent.drivers.mujoco.world import Placement, World
from device_agent.ports.driver import DriverError
from device_agent.protocol.robot_type import RobotType

__all__ = ["MujocoDriver", "Placement", "Snapshot", "World", "create", "draw"]

_OPTIONS = ("scene", "trace")


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> MujocoDriver:
    """The driver of one robot in a world of its own: the factory that ``drivers.load("mujoco")`` gives.

    Options (text): ``scene``, an MJCF file instead of the manifest's, relative to the robot's folder; ``trace``, a file
    to which the world appends its true state at 100 Hz (see ``trace.Trace``).

    Raises:
        DriverError: An option is unknown or not text.
    """
    for name, value in options.items():
        if name not in _OPTIONS:
            raise DriverError(f"driver 'mujoco' has no option '{name}'; it has: {', '.join(_OPTIONS)}")
        if not isinstance(value, str) or not value:
            raise DriverError(f"option '{name}' of driver 'mujoco' must be the path of a file, not {value!r}")
    trace = options.get("trace")
    world = World(
        folder / str(options.get("scene", robot_type.scene)),
        home=robot_type.home_rad,
        trace=Path(str(trace)) if trace else None,
    )
    return MujocoDriver(robot_type=robot_type, world=world, device=device)
