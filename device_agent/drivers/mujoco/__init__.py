"""Drivers of robots in a real-time MuJoCo simulation; a display is not needed."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.mujoco.biped_driver import BipedDriver
from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.drivers.mujoco.gripper_driver import GripperDriver
from device_agent.drivers.mujoco.hands_driver import HandsDriver
from device_agent.drivers.mujoco.omni_driver import OmniDriver
from device_agent.drivers.mujoco.wheeled_driver import WheeledDriver
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation import world_registry
from device_agent.simulation.mjcf.twin import build_twin
from device_agent.simulation.scene_assembly import Placement
from device_agent.simulation.snapshot import Snapshot
from device_agent.simulation.tasks.scene_objects import objects_of
from device_agent.simulation.world import World

__all__ = [
    "BipedDriver",
    "GripperDriver",
    "HandsDriver",
    "MujocoDriver",
    "OmniDriver",
    "Placement",
    "Snapshot",
    "WheeledDriver",
    "World",
    "build_twin",
    "create",
    "create_stepped",
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
        DriverError: An option is unknown or not text, the room cannot be used, or the manifest of its objects is wrong.
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
        return _driver(robot_type, world, device, faults=faults)
    if "scene" in options:
        raise DriverError("driver 'mujoco' takes a room or a scene, not both")
    world = world_registry.get_world(folder / str(options["room"]))
    if trace is not None:
        world.trace(trace, prefix=world_registry.prefix(device))
    prefix = world_registry.prefix(device)
    return _driver(robot_type, world, device, prefix=prefix, faults=faults)


def create_stepped(robot_type: RobotType, folder: Path, *, scene: str = "") -> tuple[MujocoDriver, World]:
    """The driver of a robot in its own scene, and its world, in which time passes in ``World.step`` only.

    Args:
        robot_type: The manifest.
        folder: The robot type's folder.
        scene: MJCF file to use instead of the manifest's, relative to the folder.

    Raises:
        DriverError: The manifest of the scene's objects is wrong.
    """
    world = World(folder / (scene or robot_type.scene), home=robot_type.home_rad, real_time=False)
    return _driver(robot_type, world, robot_type.type), world


def _driver(
    robot_type: RobotType, world: World, device: str, *, prefix: str = "", faults: Path | None = None
) -> MujocoDriver:
    kind = _driver_class(robot_type)
    if issubclass(kind, GripperDriver):
        objects = objects_of(world)
        return kind(robot_type=robot_type, world=world, device=device, prefix=prefix, faults=faults, objects=objects)
    if kind is BipedDriver and (objects := objects_of(world)) is not None:
        return HandsDriver(
            robot_type=robot_type, world=world, device=device, prefix=prefix, faults=faults, objects=objects
        )
    return kind(robot_type=robot_type, world=world, device=device, prefix=prefix, faults=faults)


def _driver_class(robot_type: RobotType) -> type[MujocoDriver]:
    """The driver class by locomotion, and for a gripper."""
    simulation = robot_type.simulation
    if simulation is not None and simulation.wheels is not None:
        return WheeledDriver
    if simulation is not None and simulation.omni_wheels is not None:
        return OmniDriver
    if simulation is not None and simulation.walk is not None:
        return BipedDriver
    if simulation is not None and simulation.gripper is not None:
        return GripperDriver
    return MujocoDriver
