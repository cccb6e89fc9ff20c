"""What some robots can do besides moving joints and base: speak, show, stiffen. The implementer's manual.

Most of it needs no driver: expressions, postures, behaviours and mouth shapes stand in the robot type's manifest, and
the runtime moves the joints. A driver that also has ``perform`` goes first, for what both its ``performs`` and its
robot type's ``capabilities`` name. It is called in the thread of the action, never in the control loop, and returns
when the thing is done.
"""

from collections.abc import Collection
from typing import Protocol, runtime_checkable

from device_agent.protocol import Express, LookAt, RunBehaviour, Say, SetStiffness, TakePosture

SPEECH, STIFFNESS, GAZE, EXPRESSIONS, BEHAVIOURS = "speech", "stiffness", "gaze", "expressions", "behaviours"
POSTURES = "postures"
"""Capabilities that a manifest may name, each with the skill below."""


class SkillError(Exception):
    """It was not done. Its text is fit for an operator, and lists what there is where a name was unknown."""


Skill = Say | SetStiffness | LookAt | Express | RunBehaviour | TakePosture
"""The messages of the wire contract that a driver can execute itself."""


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
