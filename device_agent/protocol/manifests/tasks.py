"""Manifest of the objects and tasks of a robot type, ``tasks.toml`` next to the MJCF file of its scene."""

import hashlib
import math
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from device_agent.protocol import Id, Label, Text, Vector3
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import toml
from device_agent.protocol.manifests.measured_tasks import MeasuredTask, check_measured_task

MANIFEST = "tasks.toml"
Vector2 = tuple[float, float]


class SceneObject(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An object that a reset places at random. Each range is a lowest and a highest value.

    Attributes:
        name: Body of the scene's model, on a free joint. It keeps the height that it has in the model.
        lower_m: Lowest x and y of its center in the scene [m].
        upper_m: Highest x and y of its center in the scene [m].
        yaw_rad: Rotation about the vertical [rad].
        mass_kg: Mass [kg].
        friction: Coefficient of sliding friction of all its contacts.
        size_scale: Size, as a share of that in the model; its lowest point keeps its height.
    """

    name: Id
    lower_m: Vector2
    upper_m: Vector2
    yaw_rad: Vector2 = (0.0, 0.0)
    mass_kg: Vector2
    friction: Vector2
    size_scale: Vector2 = (1.0, 1.0)


class SceneJoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A joint of the scene, as that of a drawer, which a reset sets at random.

    Attributes:
        name: Name of a slide or hinge joint of the scene's model, and of its body.
        position: Position [m or rad].
        friction: Friction of the joint [N or N m].
        damping: Damping of the joint [N s/m or N m s/rad].
    """

    name: Id
    position: Vector2
    friction: Vector2
    damping: Vector2


class Region(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A box in the scene, or in the frame of one of its movable parts.

    Attributes:
        name: Unique in the manifest.
        part: One of the manifest's ``objects`` or ``joints``, with which the box moves; none for the scene.
        lower_m: Lowest corner [m].
        upper_m: Highest corner [m].
    """

    name: Id
    part: Id | None = None
    lower_m: Vector3
    upper_m: Vector3


class Success(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """State of the simulation that completes a task.

    - With ``object`` and ``region``: a robot has lifted the object, and later the object has been at rest in the region
      without contact to a robot.
    - With ``object`` only: a robot holds the object above its start, in contact with nothing else.
    - With ``joint``: a robot has moved the joint, and later the joint has been at rest without contact to a robot.

    Attributes:
        object: One of the manifest's ``objects``.
        region: One of the manifest's ``regions``.
        point_m: Point in the object's frame that must be in the region [m]; the object's center.
        lifted_m: Height above its start to which a robot has lifted the object, in contact with nothing else [m].
        joint: One of the manifest's ``joints``.
        at_least: Lowest position of the joint [m or rad].
        rest_s: Time for which the condition holds without interruption [s].
    """

    object: Id | None = None
    region: Id | None = None
    point_m: Vector3 = (0.0, 0.0, 0.0)
    lifted_m: float | None = None
    joint: Id | None = None
    at_least: float | None = None
    rest_s: float


class Task(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Something that a robot shall do with the objects.

    Attributes:
        name: Unique in the manifest.
        label: Display name.
        description: What the robot shall do.
        movement: Movement of the robot type that attempts it.
        parameters: Parameters of the movement.
        time_limit_s: Longest duration of a trial in simulated time [s].
        success: When it is complete.
    """

    name: Id
    label: Label
    description: Text
    movement: Id
    parameters: dict[str, Any] = {}
    time_limit_s: float
    success: Success


class Tasks(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Objects and tasks of one scene.

    Attributes:
        objects: Objects in the order in which a reset places them.
        joints: Joints of drawers, doors and the like.
        scene: MJCF file with the objects, in the same folder; that of the robot type if it is empty.
        light: Brightness of the scene's lights, as a share of that in the model.
        gap_m: Smallest gap between two objects after a reset, each counted as a circle around its shape [m].
        regions: Named boxes.
        tasks: The tasks whose condition is a state of the simulation.
        measured_tasks: The tasks whose condition is a measurement of a room device.
        sha256: Hash of the manifest's text (hex), set by ``parse``: cloud and agent compare it.
    """

    objects: Annotated[tuple[SceneObject, ...], Meta(max_length=32)] = ()
    scene: str = ""
    joints: Annotated[tuple[SceneJoint, ...], Meta(max_length=32)] = ()
    light: Vector2 = (1.0, 1.0)
    gap_m: float = 0.05
    regions: Annotated[tuple[Region, ...], Meta(max_length=64)] = ()
    tasks: Annotated[tuple[Task, ...], Meta(max_length=64)] = ()
    measured_tasks: Annotated[tuple[MeasuredTask, ...], Meta(max_length=64)] = ()
    sha256: str = ""

    @property
    def all_tasks(self) -> tuple[Task | MeasuredTask, ...]:
        """The tasks of both kinds."""
        return *self.tasks, *self.measured_tasks

    def find(self, name: str) -> Task | MeasuredTask:
        """The task of this name, of either kind.

        Raises:
            ProtocolError: There is none. The message lists the names.
        """
        for task in self.all_tasks:
            if task.name == name:
                return task
        raise ProtocolError(f"no task '{name}'; there are: {', '.join(task.name for task in self.all_tasks) or 'none'}")

    def task(self, name: str) -> Task:
        """The task of this name.

        Raises:
            ProtocolError: There is none. The message lists the names.
        """
        for task in self.tasks:
            if task.name == name:
                return task
        raise ProtocolError(f"no task '{name}'; there are: {', '.join(task.name for task in self.tasks) or 'none'}")

    def region(self, name: str) -> Region:
        """The region of this name, which a checked task names."""
        return next(region for region in self.regions if region.name == name)


def load(scene: Path) -> Tasks | None:
    """Read and check the manifest next to a scene's MJCF file; ``None`` if there is none.

    Raises:
        ProtocolError: The manifest cannot be read or is wrong. The message names file and field.
    """
    path = scene.parent / MANIFEST
    if not path.is_file():
        return None
    try:
        return parse(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeError, ProtocolError) as error:
        raise ProtocolError(f"{path}: {error}") from error


def parse(text: str) -> Tasks:
    """Parse a manifest from TOML text.

    Raises:
        ProtocolError: The text is not TOML, a field is wrong, or fields contradict each other.
    """
    tasks = toml.convert(text, Tasks)
    _check_names(tasks)
    if tasks.scene and (Path(tasks.scene).name != tasks.scene or not tasks.scene.endswith(".xml")):
        raise ProtocolError(f"scene is '{tasks.scene}'; it must be the name of an .xml file in the same folder")
    if not 0 <= tasks.gap_m < math.inf:
        raise ProtocolError(f"gap_m is {tasks.gap_m}; it must be at least 0 and finite")
    _check_range("light", tasks.light, positive=True)
    for each in tasks.objects:
        _check_object(each)
    for joint in tasks.joints:
        _check_joint(joint)
    for region in tasks.regions:
        _check_region(region, tasks)
    for task in tasks.tasks:
        _check_task(task, tasks)
    for measured in tasks.measured_tasks:
        check_measured_task(measured)
    digest = hashlib.sha256(text.replace("\r\n", "\n").encode()).hexdigest()
    return msgspec.structs.replace(tasks, sha256=digest)


def _check_names(tasks: Tasks) -> None:
    groups = {
        "objects or joints": _part_names(tasks),
        "regions": [region.name for region in tasks.regions],
        "tasks": [task.name for task in tasks.all_tasks],
    }
    for label, names in groups.items():
        if len(set(names)) != len(names):
            raise ProtocolError(f"two {label} have the same name")


def _part_names(tasks: Tasks) -> list[str]:
    return [*(each.name for each in tasks.objects), *(joint.name for joint in tasks.joints)]


def _check_joint(joint: SceneJoint) -> None:
    where = f"joint '{joint.name}'"
    for field in ("position", "friction", "damping"):
        _check_range(f"{where}: {field}", getattr(joint, field))
    if min(joint.friction[0], joint.damping[0]) < 0:
        raise ProtocolError(f"{where}: friction and damping must not be negative")


def _check_region(region: Region, tasks: Tasks) -> None:
    where = f"region '{region.name}'"
    if region.part is not None:
        toml.check_known(where, "object or joint", (region.part,), _part_names(tasks))
    toml.check_box(where, region.lower_m, region.upper_m)


def _check_object(each: SceneObject) -> None:
    where = f"object '{each.name}'"
    for lower, upper in zip(each.lower_m, each.upper_m, strict=True):
        if not -math.inf < lower <= upper < math.inf:
            raise ProtocolError(f"{where}: lower_m must not be above upper_m, and all of them finite")
    _check_range(f"{where}: yaw_rad", each.yaw_rad)
    for field in ("mass_kg", "friction", "size_scale"):
        _check_range(f"{where}: {field}", getattr(each, field), positive=True)


def _check_range(label: str, ends: Vector2, *, positive: bool = False) -> None:
    lowest, highest = ends
    if not -math.inf < lowest <= highest < math.inf:
        raise ProtocolError(f"{label} is a lowest and a highest value, both finite")
    if positive:
        toml.check_positive(label, lowest)


def _check_task(task: Task, manifest: Tasks) -> None:
    where, success = f"task '{task.name}'", task.success
    toml.check_positive(f"{where}: time_limit_s", task.time_limit_s)
    toml.check_positive(f"{where}: success.rest_s", success.rest_s)
    if (success.object is None) == (success.joint is None):
        raise ProtocolError(f"{where}: success has either an object or a joint")
    if success.joint is not None:
        toml.check_known(where, "joint", (success.joint,), [each.name for each in manifest.joints])
        if success.at_least is None or not math.isfinite(success.at_least):
            raise ProtocolError(f"{where}: success.at_least must be a finite position of the joint")
        return
    toml.check_known(where, "object", (str(success.object),), [each.name for each in manifest.objects])
    if success.region is not None:
        toml.check_known(where, "region", (success.region,), [each.name for each in manifest.regions])
    if success.lifted_m is None:
        raise ProtocolError(f"{where}: success.lifted_m is missing; it is the height to which the object was lifted")
    toml.check_positive(f"{where}: success.lifted_m", success.lifted_m)
