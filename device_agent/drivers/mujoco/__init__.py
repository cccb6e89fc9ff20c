"""Drivers of robots in a real-time MuJoCo simulation; a display is not needed."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.mujoco.biped_driver import BipedDriver
from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.drivers.mujoco.wheeled_driver import WheeledDriver
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation import world_registry
from device_agent.simulation.mjcf.twin import build_twin
from device_agent.simulation.scene_assembly import Placement
from device_agent.simulation.snapshot import Snapshot
from device_agent.simulation.world import World

__all__ = [
    "BipedDriver",
    "MujocoDriver",
    "Placement",
    "Snapshot",
    "WheeledDriver",
    "World",
    "build_twin",
    "create",
    "worlds",
]

_OPTIONS = ("faults", "room", "scene", "trace")


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> MujocoDriver:
    """The driver of one robot, alone or in a room: the factory of ``drivers.load("mujoco")``.

    Options (text):
        room: A room's folder, relative to the robot type's; the robot is the manifest's entry with the device's name.
            All devices of the room share one world. Without ``room`` the robot has its own world.
        scene: MJCF file to use instead of the manifest's, relative to the robot type's folder.
        trace: File for the robot's true state at 100 Hz (see ``trace.Trace``).
        faults: File of injected faults (see ``fault_injection``); it may appear and disappear at runtime.

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
        return _driver_class(robot_type)(robot_type=robot_type, world=world, device=device, faults=faults)
    if "scene" in options:
        raise DriverError("driver 'mujoco' takes a room or a scene, not both")
    world = world_registry.get_world(folder / str(options["room"]))
    if trace is not None:
        world.trace(trace, prefix=world_registry.prefix(device))
    prefix = world_registry.prefix(device)
    return _driver_class(robot_type)(robot_type=robot_type, world=world, device=device, prefix=prefix, faults=faults)


def _driver_class(robot_type: RobotType) -> type[MujocoDriver]:
    """The driver class by locomotion."""
    simulation = robot_type.simulation
    if simulation is not None and simulation.wheels is not None:
        return WheeledDriver
    if simulation is not None and simulation.walk is not None:
        return BipedDriver
    return MujocoDriver
