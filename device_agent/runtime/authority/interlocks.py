"""Interlocks: sensor readings of the space that slow or hold a robot, for example presence in a zone or an open door.

A sensor that is silent, unknown or invalid counts as a sensor that reports danger.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from device_agent.config.interlock_rule import InterlockRule
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.readings import Reading, ReadingCache


def engagement(rule: InterlockRule, reading: Reading | None) -> str | None:
    """Why an interlock is engaged, or ``None`` if the reading shows that the room is clear."""
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
"""``Controller.restrict``: source, share of the speed that remains, reason."""


@dataclass(slots=True)
class _RuleState:
    """One rule and why it acts: ``None`` if it does not, ``""`` before the first check."""

    rule: InterlockRule
    why: str | None = ""


class Interlocks:
    """Interlocks of one device. The control loop calls ``update`` each period."""

    def __init__(
        self,
        rules: Sequence[InterlockRule],
        readings: ReadingCache,
        *,
        restrict: Restrict,
        lift: Callable[[str], None],
        record: Callable[[EventRecord, str, float], None],
    ) -> None:
        self._states = [_RuleState(rule) for rule in rules]
        self._sources = [readings.source(rule.device, rule.stream) for rule in rules]
        self._readings = readings
        self._restrict = restrict
        self._lift = lift
        self._record = record

    def update(self, now_s: float) -> None:
        """Check every rule, and act on changes."""
        for state, source in zip(self._states, self._sources, strict=True):
            why = engagement(state.rule, self._readings.read(source))
            if why != state.why:
                self._change(state, why, now_s)

    def _change(self, state: _RuleState, why: str | None, now_s: float) -> None:
        rule, before = state.rule, state.why
        if why is not None:
            self._restrict(rule.name, rule.remaining_speed, why)
            data = {"interlock": rule.name, "action": rule.action, "reason": why}
            verb = "held" if rule.action == "hold" else "slowed"
            event = EventRecord(EventKind.INTERLOCK_ENGAGED, f"the room {verb} the device: {why}", "warning", data)
            self._record(event, f"{rule.name} {why}", now_s)
        else:
            self._lift(rule.name)
            if before:
                event = EventRecord(
                    EventKind.INTERLOCK_CLEARED, "the room is clear again", data={"interlock": rule.name}
                )
                self._record(event, rule.name, now_s)
        state.why = why
