"""The room slows or holds a robot: presence in a zone, a door, whatever a sensor of the space says.

A sensor that is silent, unknown or not to be understood counts as one that says there is danger.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from device_agent.config.interlock_rule import InterlockRule
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.readings import Reading, ReadingCache


def engagement(rule: InterlockRule, reading: Reading | None) -> str | None:
    """Why an interlock is engaged, or ``None`` if the reading shows that the room is clear.

    Args:
        rule: The interlock.
        reading: The newest reading of its stream; ``None`` if none has arrived.
    """
    source = f"{rule.device}/{rule.stream}"
    if reading is None:
        return f"no measurement of {source} has arrived"
    if not reading.age_s <= rule.stale_s:
        return f"{source} is silent"
    value = reading.values.get(rule.field)
    if value is None or not math.isfinite(value):
        return f"{source} has no valid '{rule.field}'"
    return rule.condition if _is_met(rule, value) else None


def _is_met(rule: InterlockRule, value: float) -> bool:
    if rule.above is not None:
        return value > rule.above
    if rule.below is not None:
        return value < rule.below
    return value == rule.equals


Restrict = Callable[[str, float, str], None]
"""``Controller.restrict``: source, share of speed left, why."""


@dataclass(slots=True)
class _Watched:
    """One rule and what it did last: why it acts, ``None`` where it does not, ``""`` before it was first looked at."""

    rule: InterlockRule
    why: str | None = ""


class Interlocks:
    """The interlocks of one device. ``step`` is called by its control loop, each period.

    Args:
        rules: From ``agent.toml``.
        room: Listens to their streams.
        restrict: Slows or holds the device.
        lift: Lets it go.
        note: Tells that a rule began or ceased to act: fact, its code, monotonic clock [s].
    """

    def __init__(
        self,
        rules: Sequence[InterlockRule],
        room: ReadingCache,
        *,
        restrict: Restrict,
        lift: Callable[[str], None],
        note: Callable[[EventRecord, str, float], None],
    ) -> None:
        self._watched = [_Watched(rule) for rule in rules]
        self._sources = [room.source(rule.device, rule.stream) for rule in rules]
        self._room = room
        self._restrict = restrict
        self._lift = lift
        self._note = note

    def step(self, now_s: float) -> None:
        """Look at every rule; quick, and nothing happens where nothing has changed.

        Args:
            now_s: Monotonic clock [s].
        """
        for watched, source in zip(self._watched, self._sources, strict=True):
            why = engagement(watched.rule, self._room.read(source))
            if why != watched.why:
                self._change(watched, why, now_s)

    def _change(self, watched: _Watched, why: str | None, now_s: float) -> None:
        rule, before = watched.rule, watched.why
        if why is not None:
            self._restrict(rule.name, rule.remaining_speed, why)
            data = {"interlock": rule.name, "action": rule.action, "reason": why}
            verb = "held" if rule.action == "hold" else "slowed"
            happened = EventRecord(EventKind.INTERLOCK_ENGAGED, f"the room {verb} the device: {why}", "warning", data)
            self._note(happened, f"{rule.name} {why}", now_s)
        else:
            self._lift(rule.name)
            if before:
                data = {"interlock": rule.name}
                self._note(
                    EventRecord(EventKind.INTERLOCK_CLEARED, "the room is free again", data=data), rule.name, now_s
                )
        watched.why = why
