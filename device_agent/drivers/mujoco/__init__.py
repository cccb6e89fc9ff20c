"""Robots in a MuJoCo simulation, in real time. Needs no display: nothing here draws."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.mujoco.biped_driver import WalkingDriver
from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.drivers.mujoco.wheeled_driver import WheeledDriver
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation import world_registry
from device_agent.simulation.mjcf.twin import draw
from device_agent.simulation.scene_assembly import Placement
from device_agent.simulation.snapshot import Snapshot
from device_agent.simulation.world import World

__all__ = [
    "MujocoDriver",
    "Placement",
    "Snapshot",
    "WalkingDriver",
    "WheeledDriver",
    "World",
    "create",
    "draw",
    "worlds",
]

_OPTIONS = ("faults", "room", "scene", "trace")


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> MujocoDriver:
    """The driver of one robot, alone or in a room: the factory that ``drivers.load("mujoco")`` gives.

    Options (text): ``room``, a room's folder, relative to the robot's: the robot is the one of its manifest with the
    device's name, and all that is in the room shares one world; without it the robot has a world of its own, with
    ``scene``, an MJCF file instead of the manifest's, relative to the robot's folder; ``trace``, a file to which the
    world appends the robot's true state at 100 Hz (see ``trace.Trace``); ``faults``, a file with faults to put into the
    robot, which may come and go while it runs (see ``ailments``).

    Raises:
        DriverError: An option is unknown or not text, or the room cannot be used.
    """
    for name, value in options.items():
        if name not in _OPTIONS:
            raise DriverError(f"driver 'mujoco' has no option '{name}'; it has: {', '.join(_OPTIONS)}")
        if not isinstance(value, str) or not value:
            raise DriverError(f"option '{name}' of driver 'mujoco' must be the path of a file or folder, not {value!r}")
    trace, faults = (Path(str(options[name])) if name in options else None for name in ("trace", "faults"))
    if "room" not in options:
        scene = folder / str(options.get("scene", robot_type.scene))
        world = World(scene, home=robot_type.home_rad, trace=trace)
        return _kind(robot_type)(robot_type=robot_type, world=world, device=device, faults=faults)
    if "scene" in options:
        raise DriverError("driver 'mujoco' takes a room or a scene, not both")
    world = world_registry.of(folder / str(options["room"]))
    if trace is not None:
        world.trace(trace, prefix=world_registry.prefix(device))
    prefix = world_registry.prefix(device)
    return _kind(robot_type)(robot_type=robot_type, world=world, device=device, prefix=prefix, faults=faults)


def _kind(robot_type: RobotType) -> type[MujocoDriver]:
    """What drives robots of this type: by how they get about."""
    simulation = robot_type.simulation
    if simulation is not None and simulation.wheels is not None:
        return WheeledDriver
    if simulation is not None and simulation.walk is not None:
        return WalkingDriver
    return MujocoDriver
