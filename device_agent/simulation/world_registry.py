"""The simulated rooms of this process: one shared ``World`` per room."""

import math
import threading
from pathlib import Path
from weakref import WeakValueDictionary, proxy

from device_agent.ports.driver import DriverError
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type, room
from device_agent.protocol.manifests.room import Room, RoomRobot
from device_agent.simulation.room.climate import Climate
from device_agent.simulation.room.light import Light
from device_agent.simulation.room.pedestrian import Pedestrian
from device_agent.simulation.room.sound import Sound
from device_agent.simulation.scene_assembly import Placement
from device_agent.simulation.world import World

_worlds: WeakValueDictionary[Path, World] = WeakValueDictionary()
_lock = threading.Lock()


def get_world(folder: Path) -> World:
    """The world of a room; the same object as long as it is referenced.

    Every robot of the room's manifest stands in it, whether an agent runs it or not. The model is not built yet.

    Args:
        folder: The room's folder, ``robots/rooms/<room>``; robot types are in ``robots``.

    Raises:
        DriverError: The manifest of the room or of one of its robots is missing or invalid, or the room has no model.
    """
    folder = folder.resolve()
    with _lock:
        world = _worlds.get(folder)
        if world is None:
            world = _worlds[folder] = _make(folder)
        return world


def prefix(name: str) -> str:
    """Prefix of all model names of this robot."""
    return f"{name}/"


def _make(folder: Path) -> World:
    try:
        manifest = room.load(folder)
        types = {robot.type: robot_type.load(folder.parents[1] / robot.type) for robot in manifest.robots}
    except ProtocolError as error:
        raise DriverError(str(error)) from error
    if not manifest.model:
        raise DriverError(f"room '{manifest.room}' is a real room without a model and cannot be simulated")
    return make(manifest, folder, types)


def make(manifest: Room, folder: Path, types: dict[str, robot_type.RobotType]) -> World:
    """A new world of a room, with its people, climate, light and sound.

    Args:
        manifest: The room's manifest.
        folder: Folder of its model; robot types are in ``folder/../..``.
        types: The robot types that it names.
    """
    home = {
        prefix(robot.name) + joint: position
        for robot in manifest.robots
        for joint, position in types[robot.type].home_rad.items()
    }
    world = World(
        folder / manifest.model,
        robots=[
            _placement(robot, folder.parents[1] / robot.type / types[robot.type].model) for robot in manifest.robots
        ],
        home=home,
        settings=manifest.start,
    )
    # Weak reference: processes must not prevent its deletion.
    reference = proxy(world)
    people = [Pedestrian(person) for person in manifest.people]
    for person in people:
        world.add(person)
    world.add(Climate(manifest, reference, people))
    world.add(Light(manifest, reference))
    world.add(Sound(manifest, reference, people))
    return world


def _placement(robot: RoomRobot, model: Path) -> Placement:
    return Placement(
        prefix=prefix(robot.name),
        model=model,
        position_m=robot.position_m,
        quaternion=(math.cos(robot.yaw_rad / 2), 0.0, 0.0, math.sin(robot.yaw_rad / 2)),
    )
