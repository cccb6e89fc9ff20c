"""Port: skills of a driver other than moving joints and base. The implementer's manual.

Most skills need no driver: the manifest contains expressions, postures, behaviours and mouth shapes, and the runtime
moves the joints. A driver with ``perform`` takes precedence for capabilities that both its ``performs`` and its robot
type name. ``perform`` runs in the thread of the action, never in the control loop, and returns when the skill is
complete.
"""

from collections.abc import Collection
from typing import Protocol, runtime_checkable

from device_agent.protocol import Express, LookAt, RunBehaviour, Say, SetStiffness, TakePosture


class SkillError(Exception):
    """The skill failed. The message is shown to operators and lists the known names if a name was unknown."""


Skill = Say | SetStiffness | LookAt | Express | RunBehaviour | TakePosture
"""The messages of the wire contract that a driver can execute itself."""


class SkillContext(Protocol):
    """Context of a running skill."""

    @property
    def ended(self) -> bool:
        """Whether the action lost control (Stop, lease, cancellation, link): stop and return."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until the action has ended, at most ``timeout_s`` [s]. Returns whether it has."""

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
