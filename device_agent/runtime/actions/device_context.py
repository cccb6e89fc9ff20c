"""Parts of a device that its actions and scripts use."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from msgspec import StructMeta

from device_agent.ports.driver import Observation
from device_agent.ports.floor_map import ObstacleMap
from device_agent.ports.geometry import RobotGeometry
from device_agent.ports.script_calls import GetLatest, GetState, Home, Play, Wait
from device_agent.ports.skills import HasBehaviours, HasControls, RobotBehaviour, Skills
from device_agent.protocol import LookAt, MovePose, RunBehaviour, SetControl, SetStiffness, TakePosture
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.task_kinds import tag, tasks_of
from device_agent.runtime.actions.speech_output import SpeechOutput
from device_agent.runtime.actions.task_monitors import TaskMonitors
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.localization import PoseEstimator
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

MAX_BEHAVIOURS = 128
"""Maximum number of behaviours in a description."""


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """Parts of a device that its actions use.

    Attributes:
        observe: Newest observation, or ``None`` before the first one.
        skills: Driver with skills, if it has any.
        behaviours: Driver of a robot with behaviours of its own, if it has any.
        controls: Driver of a robot with values that can be set, if it has any.
        own_readings: Newest reading of each stream of this device except ``joints``.
        name: Name of the device in the positions that room sensors publish.
        obstacle_map: Newest obstacle map of the room, if sensors publish one. ``go_to`` needs it.
        pose_estimator: Localization of the device in the room.
        wake: Called after a goal has started; see ``ControlLoop.wake``.
        stepped: Whether simulated time passes only while the action waits, so that scripts wait by a call.
        task_monitors: Monitors of the robot type's tasks, for trials.
    """

    robot_type: RobotType
    controller: Controller
    observe: Callable[[], Observation | None]
    geometry: RobotGeometry | None
    skills: Skills | None
    readings: ReadingCache
    own_readings: Callable[[], Mapping[str, Reading]] = dict
    room_device: RoomDevice | None = None
    name: str = ""
    obstacle_map: Callable[[], ObstacleMap | None] | None = None
    speech: SpeechOutput = field(default_factory=SpeechOutput)
    pose_estimator: PoseEstimator = field(default_factory=PoseEstimator)
    wake: Callable[[], None] = lambda: None
    behaviours: HasBehaviours | None = None
    controls: HasControls | None = None
    stepped: bool = False
    task_monitors: TaskMonitors = field(default_factory=TaskMonitors)

    def observation(self) -> Observation:
        """The newest observation.

        Raises:
            Refused: There is none yet.
        """
        observation = self.observe()
        if observation is None:
            raise Refused("no_measurement", "the robot has not been measured yet")
        return observation

    def measured(self) -> dict[str, Any]:
        """Measured joint positions for results; empty before the first observation, and without joints."""
        observation = self.observe()
        if observation is None or not self.robot_type.joints:
            return {}
        return {"position_rad": by_name(self.robot_type, observation.position_rad)}

    def supported(self) -> tuple[StructMeta, ...]:
        """Types of the calls that this robot supports."""
        joint_calls = (Play, Home) if self.robot_type.joints else ()
        return *self._tasks(), *self._control_calls(), *joint_calls, GetState, GetLatest, *(Wait,) * self.stepped

    def _tasks(self) -> tuple[StructMeta, ...]:
        return tasks_of(
            self.robot_type,
            performed=() if self.skills is None else self.skills.performs,
            has_model=self.geometry is not None,
            has_map=self.obstacle_map is not None,
            has_behaviours=self.behaviours is not None,
        )

    def script_calls(self) -> tuple[str, ...]:
        """Names of the script API's methods that this robot supports."""
        return tuple(SCRIPT_NAMES.get(call, tag(call)) for call in self.supported())

    def tasks(self) -> tuple[str, ...]:
        """Kinds of the wire contract's tasks that this robot supports."""
        return tuple(map(tag, (*self._tasks(), *self._control_calls())))

    def _control_calls(self) -> tuple[StructMeta, ...]:
        return (SetControl,) if self.controls is not None and self.controls.controls else ()

    def robot_behaviours(self) -> tuple[RobotBehaviour, ...]:
        """The robot's own behaviours, as far as they are known now and a description can list them."""
        named = self.robot_type.behaviours
        own = () if self.behaviours is None else self.behaviours.behaviours
        return tuple(each for each in own if each.name not in named)[: max(0, MAX_BEHAVIOURS - len(named))]

    def is_recovery(self, name: str) -> bool:
        """Whether this is a behaviour that may run while Stop is latched."""
        return any(each.recovery and each.name == name for each in self.robot_behaviours())

    def performs(self, capability: str) -> bool:
        """Whether the driver executes this skill itself; otherwise the manifest describes it."""
        driver = self.skills
        return driver is not None and capability in self.robot_type.capabilities and capability in driver.performs


def by_name(robot_type: RobotType, values: Sequence[float]) -> dict[str, float]:
    """Joint name → value, of values in joint order."""
    return dict(zip((joint.name for joint in robot_type.joints), values, strict=True))
