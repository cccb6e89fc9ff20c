"""The simulated rooms of this process: one ``World`` for each, shared by all that is in it."""

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
from device_agent.simulation.room.pedestrian import Walker
from device_agent.simulation.room.sound import Sound
from device_agent.simulation.scene_assembly import Placement
from device_agent.simulation.world import World

_worlds: WeakValueDictionary[Path, World] = WeakValueDictionary()
_lock = threading.Lock()


def of(folder: Path) -> World:
    """The world of a room; the same one for as long as somebody keeps it.

    Every robot of the room's manifest stands in it, whether an agent runs it or not. Nothing of MuJoCo is built yet.

    Args:
        folder: The room's, ``robots/rooms/<room>``; robot types are looked for in ``robots``.

    Raises:
        DriverError: The room's manifest or that of one of its robots is missing or wrong, or the room has no model.
    """
    folder = folder.resolve()
    with _lock:
        world = _worlds.get(folder)
        if world is None:
            world = _worlds[folder] = _make(folder)
        return world


def prefix(name: str) -> str:
    """What stands before every name of the model of the robot that is called so."""
    return f"{name}/"


def _make(folder: Path) -> World:
    try:
        manifest = room.load(folder)
        types = {robot.type: robot_type.load(folder.parents[1] / robot.type) for robot in manifest.robots}
    except ProtocolError as error:
        raise DriverError(str(error)) from error
    if not manifest.model:
        raise DriverError(f"room '{manifest.room}' has no model: it is a real one and cannot be simulated")
    return make(manifest, folder, types)


def make(manifest: Room, folder: Path, types: dict[str, robot_type.RobotType]) -> World:
    """A new world of a room, with all that goes on in it by itself.

    Args:
        manifest: The room's.
        folder: Where its model is; robot types are in ``folder/../..``.
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
    # What goes on in it does not keep it alive: it ends when nobody who takes part is left.
    its = proxy(world)
    people = [Walker(person) for person in manifest.people]
    for person in people:
        world.add(person)
    world.add(Climate(manifest, its, people))
    world.add(Light(manifest, its))
    world.add(Sound(manifest, its, people))
    return world


def _placement(robot: RoomRobot, model: Path) -> Placement:
    return Placement(
        prefix=prefix(robot.name),
        model=model,
        position_m=robot.position_m,
        quaternion=(math.cos(robot.yaw_rad / 2), 0.0, 0.0, math.sin(robot.yaw_rad / 2)),
    )
