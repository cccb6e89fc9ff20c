"""The queue of a device: actions that wait for its slot, first come, first served.

Nothing starts by itself after something went wrong: when an action fails, or somebody stops the device, those behind it
are dropped, each with the reason.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Final

from function_app.domain.actions.action import Status
from function_app.domain.common.problems import Problem

MAX_QUEUED: Final = 32
"""Actions that may wait for one device."""
FAILED_BEFORE = "earlier-failed"
STOPPED = "stopped"
UNPAIRED = "unpaired"
MOVED = "moved"
REMOVED = "removed"
UNSHARED = "unshared"
KEY_ENDED = "api-key-ended"
SIGNED_OUT = "signed-out"
DROPPED: Final = {
    FAILED_BEFORE: (
        Status.CANCELLED,
        "An action before it failed, and nothing goes on by itself then. Look at the device, and start it again.",
    ),
    STOPPED: (
        Status.CANCELLED,
        "The device was stopped, and nothing resumes by itself. Reset it, and start it again.",
    ),
    UNPAIRED: (Status.FAILED, "The device was un-paired before it ended."),
    MOVED: (Status.FAILED, "The device's agent was moved to another space before it ended. Start it again."),
    REMOVED: (Status.FAILED, "Its agent no longer has this device."),
    UNSHARED: (Status.FAILED, "The device is no longer shared with who started it."),
    KEY_ENDED: (
        Status.FAILED,
        "The API key that started it has ended, or may not operate this device any more. Make another one.",
    ),
    SIGNED_OUT: (Status.FAILED, "Who started it has signed out, which ends what they had begun. Start it again."),
}
"""Why a waiting action ends without its turn: code → its end and what people read."""


@dataclass(frozen=True, slots=True)
class ActionQueue:
    """Who waits.

    Attributes:
        pairing: Of the agent. A queue of an earlier owner's pairing is nobody's.
        actions: Ids, the next one first.
        dropped: Ids that have lost their place and are still to be ended → the code of the reason.
    """

    pairing: str
    actions: tuple[str, ...] = ()
    dropped: dict[str, str] = field(default_factory=dict)

    @property
    def empty(self) -> bool:
        """Whether there is nothing to do."""
        return not self.actions and not self.dropped

    def contains(self, action: str) -> bool:
        """Whether ``action`` is in it in one way or the other."""
        return action in self.actions or action in self.dropped

    def position(self, action: str) -> int | None:
        """1 for the next one."""
        return self.actions.index(action) + 1 if action in self.actions else None

    def with_last(self, action: str) -> "ActionQueue":
        """With ``action`` as the last.

        Raises:
            Problem: ``queue-full``.
        """
        if len(self.actions) >= MAX_QUEUED:
            detail = f"{MAX_QUEUED} actions wait for this device. Wait until one has ended, or cancel one."
            raise Problem("queue-full", 409, "The queue is full", detail)
        return replace(self, actions=(*self.actions, action))

    def without(self, action: str) -> "ActionQueue":
        """After ``action`` got its turn or its end."""
        actions = tuple(other for other in self.actions if other != action)
        return replace(self, actions=actions, dropped={id_: why for id_, why in self.dropped.items() if id_ != action})

    def with_cancelled(self, actions: Collection[str], why: str) -> "ActionQueue":
        """Some of them dropped; the same object when none of these waits."""
        lost = [action for action in self.actions if action in actions]
        if not lost:
            return self
        kept = tuple(action for action in self.actions if action not in lost)
        return replace(self, actions=kept, dropped={**self.dropped, **dict.fromkeys(lost, why)})

    def with_all_cancelled(self, why: str) -> "ActionQueue":
        """All of them dropped; the same object when nobody waits."""
        return self.with_cancelled(self.actions, why)
