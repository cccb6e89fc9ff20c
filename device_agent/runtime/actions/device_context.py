"""A device as its scripts and orders meet it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

from msgspec import StructMeta

from device_agent.ports import skills
from device_agent.ports.driver import Observation
from device_agent.ports.floor_map import ObstacleMap
from device_agent.ports.geometry import RobotGeometry
from device_agent.ports.script_calls import AskLatest, AskState, Home, Play
from device_agent.ports.skills import Skills
from device_agent.protocol import (
    Drive,
    Express,
    GoTo,
    LookAt,
    MoveJoints,
    MovePose,
    RobotTask,
    RunBehaviour,
    Say,
    SetStiffness,
    TakePosture,
)
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.actions.speech_output import SpeechOutput
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import Reading, ReadingCache
from device_agent.runtime.room.room_device import RoomDevice

SCRIPT_NAMES: Mapping[StructMeta, str] = {
    MovePose: "move_to",
    LookAt: "look",
    SetStiffness: "stiffness",
    TakePosture: "posture",
    RunBehaviour: "behaviour",
}
"""Methods of the script API whose name differs from the kind of their message."""
CARTESIAN = "cartesian"
"""A capability that a manifest may name, besides those of ``ports.skills``."""


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """A device as its scripts meet it.

    Attributes:
        robot_type: Joints, frames, capabilities, home.
        controller: What moves it.
        observe: The newest measurement, or ``None`` before the first.
        geometry: Its shape, where its type has a model.
        skills: What its driver can besides.
        room: What the space's other devices have measured last.
        reported: The newest of each of its own streams besides ``joints``.
        instrument: The device as a room's, where it is one.
        name: As the room's positions name it.
        ground: What stands in its room, while somebody sees that; without it, it goes nowhere by itself.
        speaker: Who says what it is to say.
        hurry: Called when something is asked of the controller: see ``ControlLoop.hurry``.
    """

    robot_type: RobotType
    controller: Controller
    observe: Callable[[], Observation | None]
    geometry: RobotGeometry | None
    skills: Skills | None
    room: ReadingCache
    reported: Callable[[], Mapping[str, Reading]] = dict
    instrument: RoomDevice | None = None
    name: str = ""
    ground: Callable[[], ObstacleMap | None] | None = None
    speaker: SpeechOutput = field(default_factory=SpeechOutput)
    hurry: Callable[[], None] = lambda: None

    def seen(self) -> Observation:
        """The newest measurement.

        Raises:
            Refused: There is none yet.
        """
        seen = self.observe()
        if seen is None:
            raise Refused("no_measurement", "the robot has not been measured yet")
        return seen

    def measured(self) -> dict[str, Any]:
        """Where it is, as results show it; empty before the first measurement, and without joints."""
        seen = self.observe()
        if seen is None or not self.robot_type.joints:
            return {}
        return {"position_rad": by_name(self.robot_type, seen.position_rad)}

    def supported(self) -> tuple[StructMeta, ...]:
        """Types of the calls that this robot supports."""
        kind, named = self.robot_type, set(self.robot_type.capabilities)
        by_driver = {capability for capability in named if self.performs(capability)}
        has: dict[StructMeta, bool] = {
            MoveJoints: bool(kind.joints),
            Play: bool(kind.joints),
            Home: bool(kind.joints),
            MovePose: CARTESIAN in named and self.geometry is not None,
            Drive: kind.base is not None,
            GoTo: kind.base is not None and self.ground is not None,
            LookAt: skills.GAZE in by_driver or (kind.gaze is not None and self.geometry is not None),
            Say: skills.SPEECH in named,
            SetStiffness: skills.STIFFNESS in by_driver,
            Express: skills.EXPRESSIONS in by_driver or bool(kind.expressions),
            TakePosture: skills.POSTURES in by_driver or bool(kind.postures),
            RunBehaviour: skills.BEHAVIOURS in by_driver or bool(kind.behaviours),
            AskState: True,
            AskLatest: True,
        }
        return tuple(call for call, available in has.items() if available)

    def script_calls(self) -> tuple[str, ...]:
        """Names of the script API's methods that this robot supports."""
        return tuple(SCRIPT_NAMES.get(call, tag(call)) for call in self.supported())

    def tasks(self) -> tuple[str, ...]:
        """Kinds of the wire contract's tasks that this robot supports."""
        supported = self.supported()
        return tuple(tag(task) for task in get_args(RobotTask) if task in supported)

    def performs(self, capability: str) -> bool:
        """Whether its driver does this itself; else it is done by what the manifest says."""
        able = self.skills
        return able is not None and capability in self.robot_type.capabilities and capability in able.performs


def tag(call: StructMeta) -> str:
    """The ``kind`` of a message type."""
    return str(call.__struct_config__.tag)


def by_name(robot_type: RobotType, values: Sequence[float]) -> dict[str, float]:
    """Values in joint order as joint name → value."""
    return dict(zip((joint.name for joint in robot_type.joints), values, strict=True))
