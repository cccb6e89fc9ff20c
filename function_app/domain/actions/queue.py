"""The queue of a device: actions that wait for its slot, in order of arrival.

After a failure, an unknown outcome or a Stop, all waiting actions are cancelled, each with the reason.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Final

from function_app.domain.actions.action import KEY_ENDED, SIGNED_OUT, UNSHARED, Status
from function_app.domain.common.problems import Problem

MAX_QUEUED: Final = 32
"""Maximum number of actions that wait for one device."""
FAILED_BEFORE = "earlier-failed"
UNKNOWN_BEFORE = "earlier-unknown"
STOPPED = "stopped"
UNPAIRED = "unpaired"
MOVED = "moved"
REMOVED = "removed"
RESTORED = "restored"
DROPPED: Final = {
    FAILED_BEFORE: (
        Status.CANCELLED,
        "An earlier action failed, so the queued actions were cancelled. Check the device, then start it again.",
    ),
    UNKNOWN_BEFORE: (
        Status.CANCELLED,
        "It is not known how an earlier action ended, so the queued actions were cancelled. Check the device.",
    ),
    STOPPED: (
        Status.CANCELLED,
        "The device was stopped, so the queued actions were cancelled. Reset it, then start it again.",
    ),
    UNPAIRED: (Status.FAILED, "The device was un-paired before it ended."),
    MOVED: (Status.FAILED, "The device's agent was moved to another space before it ended. Start it again."),
    REMOVED: (Status.FAILED, "Its agent no longer has this device."),
    UNSHARED: (Status.FAILED, "The device is no longer shared with the account that started it."),
    KEY_ENDED: (
        Status.FAILED,
        "The API key that started it was revoked, has expired, or may not operate this device. Create a new key.",
    ),
    RESTORED: (
        Status.CANCELLED,
        "It was queued in a restored backup; it may have run since. Check the device before starting it again.",
    ),
    SIGNED_OUT: (Status.FAILED, "The session that started it has signed out. Start it again."),
}
"""Reasons to end a waiting action: code → terminal status and message."""


@dataclass(frozen=True, slots=True)
class ActionQueue:
    """The waiting actions of a device.

    Attributes:
        pairing: Pairing of the agent. A queue of an earlier pairing is ignored.
        actions: Action ids, next one first.
        dropped: Ids of cancelled actions that must still be ended → reason code.
    """

    pairing: str
    actions: tuple[str, ...] = ()
    dropped: dict[str, str] = field(default_factory=dict)

    @property
    def empty(self) -> bool:
        """Whether no action waits and no dropped action must be ended."""
        return not self.actions and not self.dropped

    def contains(self, action: str) -> bool:
        """Whether ``action`` is waiting or dropped."""
        return action in self.actions or action in self.dropped

    def position(self, action: str) -> int | None:
        """Position in the queue; 1 is next."""
        return self.actions.index(action) + 1 if action in self.actions else None

    def with_last(self, action: str) -> "ActionQueue":
        """The queue with ``action`` at the end. Raises ``queue-full``."""
        if len(self.actions) >= MAX_QUEUED:
            detail = f"{MAX_QUEUED} actions wait for this device. Wait until one has ended, or cancel one."
            raise Problem("queue-full", 409, "The queue is full", detail)
        return replace(self, actions=(*self.actions, action))

    def without(self, action: str) -> "ActionQueue":
        """The queue without ``action``, after it was started or ended."""
        actions = tuple(other for other in self.actions if other != action)
        return replace(
            self, actions=actions, dropped={id_: code for id_, code in self.dropped.items() if id_ != action}
        )

    def with_cancelled(self, actions: Collection[str], code: str) -> "ActionQueue":
        """The queue with some actions cancelled; the same object if none of them waits."""
        cancelled = [action for action in self.actions if action in actions]
        if not cancelled:
            return self
        remaining = tuple(action for action in self.actions if action not in cancelled)
        return replace(self, actions=remaining, dropped={**self.dropped, **dict.fromkeys(cancelled, code)})

    def with_all_cancelled(self, code: str) -> "ActionQueue":
        """The queue with all actions cancelled; the same object if none waits."""
        return self.with_cancelled(self.actions, code)
