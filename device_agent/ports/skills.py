"""Port: skills of a driver other than moving joints and base, the robot's own behaviours, and monitors of tasks.

This is the implementer's manual.

Most skills need no driver: the manifest contains expressions, postures, behaviours and mouth shapes, and the runtime
moves the joints. A driver with ``perform`` takes precedence for capabilities that both its ``performs`` and its robot
type name. ``perform`` runs in the thread of the action, never in the control loop, and returns when the skill is
complete.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from device_agent.protocol import Control, Express, LookAt, RunBehaviour, Say, SetStiffness, TakePosture, TrialCause
from device_agent.protocol.manifests.tasks import Tasks


class SkillError(Exception):
    """The skill failed. The message is shown to operators and lists the known names if a name was unknown."""


Skill = Say | SetStiffness | LookAt | Express | RunBehaviour | TakePosture
"""The messages of the wire contract that a driver can execute itself."""


class BehaviourContext(Protocol):
    """Context of a running behaviour of the robot."""

    @property
    def ended(self) -> bool:
        """Whether the action lost control (Stop, lease, cancellation, link): stop and return."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until the action has ended, at most ``timeout_s`` [s]. Returns whether it has."""


class SkillContext(BehaviourContext, Protocol):
    """Context of a running skill."""

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        """Move to positions [rad] and wait. The only way for a skill to move joints: the agent's limits apply.

        Raises:
            SkillError: The agent rejected or interrupted the motion.
        """


@runtime_checkable
class Skills(Protocol):
    """A driver with skills."""

    @property
    def performs(self) -> Collection[str]:
        """Capabilities that ``perform`` executes."""

    def perform(self, skill: Skill, context: SkillContext) -> None:
        """Execute a skill to its end, or until the action has ended.

        Raises:
            SkillError: The skill failed.
        """


@dataclass(frozen=True, slots=True)
class RobotBehaviour:
    """A behaviour that the robot itself provides.

    Attributes:
        name: Name for ``RunBehaviour``; an ``Id``. A behaviour of the manifest with the same name takes precedence.
        title: The robot's own name of it, for operators; a ``Label``.
        recovery: Whether it removes a fault. A recovery never moves joints, and may also run while Stop is latched.
    """

    name: str
    title: str
    recovery: bool = False


@runtime_checkable
class HasBehaviours(Protocol):
    """A driver of a robot with behaviours of its own, which the action ``RunBehaviour`` runs.

    During a behaviour the robot moves its joints itself, and the agent's limits do not apply. Meanwhile ``send``
    commands nothing and returns the measured positions, and a watchdog ends the behaviour if ``send`` is not called.
    The agent adopts the positions that ``send`` returned last, and holds there. So ``run_behaviour`` returns when the
    robot is at rest and ``send`` has returned that position.
    """

    @property
    def behaviours(self) -> Sequence[RobotBehaviour]:
        """The robot's behaviours, as far as they are known now. Only accesses memory; any thread may read it."""

    def run_behaviour(self, name: str, context: BehaviourContext) -> None:
        """Run a behaviour until the robot has reported its end. Called in the thread of the action.

        When the action ends, also by Stop, it ends the behaviour and returns after the robot is at rest.

        Raises:
            SkillError: The behaviour is unknown, not permitted or has failed, or the robot did not end it.
        """


@runtime_checkable
class HasControls(Protocol):
    """A driver of a robot with values besides joints that operators set, such as outputs or a gripper."""

    @property
    def controls(self) -> Sequence[Control]:
        """The values and their limits; constant."""

    def set_control(self, name: str, value: float, context: BehaviourContext) -> float:
        """Set a value, which is inside its limits. Called in the thread of the action.

        When the action ends, also by Stop, motion such as that of a gripper ends.

        Returns:
            The value that the robot has confirmed.

        Raises:
            SkillError: The robot does not confirm it.
        """


@dataclass(frozen=True, slots=True)
class TaskState:
    """What a monitor has observed until now.

    Attributes:
        time_s: Time on the monitor's clock [s]; simulated time in a simulation.
        met: Whether the condition of the task has been met for the required time until now.
        failure: Cause of the failure if the trial ended now without success.
        detail: That cause in words.
    """

    time_s: float
    met: bool
    failure: TrialCause
    detail: str


class TaskMonitor(Protocol):
    """Observes one task during a trial. Neither the movement nor an operator can change what it reports."""

    def restart(self) -> None:
        """Observe a new trial from now on."""

    def state(self) -> TaskState:
        """The newest observation.

        Raises:
            DriverError: The task is no longer observed.
        """

    def close(self) -> None:
        """End the observation."""


@runtime_checkable
class ObservesTasks(Protocol):
    """A driver that observes tasks whose condition is a state of the simulation."""

    def observe_task(self, manifest: Tasks, task: str) -> TaskMonitor:
        """Start to observe a task of a manifest.

        Raises:
            DriverError: The robot is not in a scene with the objects of the task.
        """
