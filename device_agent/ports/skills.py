"""What some robots can do besides moving joints and base: speak, show, stiffen. The implementer's manual.

Most of it needs no driver: expressions, postures, behaviours and mouth shapes stand in the robot type's manifest, and
the runtime moves the joints. A driver that also has ``perform`` goes first, for what both its ``performs`` and its
robot type's ``capabilities`` name. It is called in the thread of the action, never in the control loop, and returns
when the thing is done.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

SPEECH, STIFFNESS, GAZE, EXPRESSIONS, BEHAVIOURS = "speech", "stiffness", "gaze", "expressions", "behaviours"
POSTURES = "postures"
"""Capabilities that a manifest may name, each with the skill below."""


class SkillError(Exception):
    """It was not done. Its text is fit for an operator, and lists what there is where a name was unknown."""


@dataclass(frozen=True, slots=True)
class Say:
    """Speak ``text``; ``language`` as ``en`` or ``sk``, or empty for the robot's own."""

    text: str
    language: str = ""


@dataclass(frozen=True, slots=True)
class Stiffen:
    """Hold with ``value``, 0 (limp) to 1; empty ``joints``: all. Of these joints only that the robot has."""

    value: float
    joints: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class LookAt:
    """Turn the gaze to a point in the robot's base frame [m]."""

    position_m: tuple[float, float, float]
    speed: float


@dataclass(frozen=True, slots=True)
class Express:
    """Show the expression ``name``, ``strength`` 0 to 1."""

    name: str
    strength: float = 1.0


@dataclass(frozen=True, slots=True)
class Behave:
    """Run the behaviour ``name``."""

    name: str


@dataclass(frozen=True, slots=True)
class Pose:
    """Take the posture ``name``; ``speed`` is the share of each joint's velocity limit."""

    name: str
    speed: float = 0.5


Skill = Say | Stiffen | LookAt | Express | Behave | Pose


class Stage(Protocol):
    """What a skill has while it lasts."""

    @property
    def ended(self) -> bool:
        """Whether the action has lost the device (Stop, lease, cancel, link): stop what goes on, and return."""

    def wait(self, timeout_s: float) -> bool:
        """Wait [s], or until it has ended; whether it has."""

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        """Move and wait until there [rad]. The only way for a skill to move a joint: the agent's limits hold.

        Raises:
            SkillError: The agent refused or interrupted it.
        """


@runtime_checkable
class Skills(Protocol):
    """A driver with skills."""

    @property
    def performs(self) -> Collection[str]:
        """The capabilities that ``perform`` is for."""

    def perform(self, skill: Skill, stage: Stage) -> None:
        """Do it, to its end, or until ``stage`` has ended.

        Raises:
            SkillError: It cannot.
        """
