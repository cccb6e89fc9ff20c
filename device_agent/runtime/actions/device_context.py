"""A device as its scripts and orders meet it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from device_agent.ports import skills
from device_agent.ports.driver import Observation
from device_agent.ports.floor_map import ObstacleMap
from device_agent.ports.geometry import RobotGeometry
from device_agent.ports.skills import Skills
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.actions.speech_output import SpeechOutput
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import Reading, ReadingCache
from device_agent.runtime.room.room_device import RoomDevice

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

    def can(self) -> tuple[str, ...]:
        """Names of the calls that scripts have on this robot."""
        kind, named = self.robot_type, set(self.robot_type.capabilities)
        by_skill = {capability for capability in named if self.performs(capability)}
        has = {
            "move_joints": bool(kind.joints),
            "play": bool(kind.joints),
            "home": bool(kind.joints),
            "move_to": CARTESIAN in named and self.geometry is not None,
            "drive": kind.base is not None,
            "go_to": kind.base is not None and self.ground is not None,
            "look": skills.GAZE in by_skill or (kind.gaze is not None and self.geometry is not None),
            "say": skills.SPEECH in named,
            "stiffness": skills.STIFFNESS in by_skill,
            "express": skills.EXPRESSIONS in by_skill or bool(kind.expressions),
            "posture": skills.POSTURES in by_skill or bool(kind.postures),
            "behaviour": skills.BEHAVIOURS in by_skill or bool(kind.behaviours),
            "state": True,
            "latest": True,
        }
        return tuple(name for name, there in has.items() if there)

    def performs(self, capability: str) -> bool:
        """Whether its driver does this itself; else it is done by what the manifest says."""
        able = self.skills
        return able is not None and capability in self.robot_type.capabilities and capability in able.performs


def by_name(robot_type: RobotType, values: Sequence[float]) -> dict[str, float]:
    """Values in joint order as joint name → value."""
    return dict(zip((joint.name for joint in robot_type.joints), values, strict=True))
