"""The room slows or holds a robot: presence in a zone, a door, whatever a sensor of the space says.

A sensor that is silent, unknown or not to be understood counts as one that says there is danger.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.protocol import Field, Id, InterlockRule
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.readings import Reading, ReadingCache

_HOLD = 0.0


class Interlock(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[devices.interlocks]]`` of ``agent.toml``. Exactly one of ``above``, ``below`` and ``equals`` is given.

    Attributes:
        device: Id of a device of the same space, or the name of one of this agent's own.
        stream: Its stream.
        field: The value in it.
        above: Acts while the value is greater.
        below: Acts while the value is less.
        equals: Acts while the value is this.
        action: What it does.
        speed: With ``slow``: the share of speed that is left.
        stale_s: Acts as well when the newest value is older [s].
    """

    device: Id
    stream: Id
    field: Field
    above: float | None = None
    below: float | None = None
    equals: bool | float | None = None
    action: Literal["slow", "hold"] = "hold"
    speed: Annotated[float, Meta(gt=0, lt=1)] = 0.2
    stale_s: Annotated[float, Meta(ge=0.1, le=60)] = 2.0

    def __post_init__(self) -> None:
        """Refuse what says nothing, or two things.

        Raises:
            ValueError: As above.
        """
        given = [value for value in (self.above, self.below, self.equals) if value is not None]
        if len(given) != 1:
            raise ValueError(f"the interlock on '{self.field}' needs exactly one of above, below, equals")
        if not math.isfinite(given[0]):
            raise ValueError(f"the interlock on '{self.field}' needs a finite number")

    @property
    def name(self) -> str:
        """As ``state``, ``desc`` and events name it."""
        return f"{self.device}/{self.stream} {self.condition}"

    @property
    def condition(self) -> str:
        """When it acts, as text."""
        if self.above is not None:
            return f"{self.field} > {self.above:g}"
        if self.below is not None:
            return f"{self.field} < {self.below:g}"
        return f"{self.field} = {str(self.equals).lower()}"

    @property
    def shown(self) -> InterlockRule:
        """As ``desc`` shows it."""
        return InterlockRule(name=self.name, action=self.action, speed=self.left, stale_ms=round(self.stale_s * 1000))

    @property
    def left(self) -> float:
        """The share of speed that is left while it acts."""
        return _HOLD if self.action == "hold" else self.speed

    def acts(self, reading: Reading | None) -> str | None:
        """Why it acts now, or ``None`` where the room is known to be free.

        Args:
            reading: The newest of its stream.
        """
        if reading is None:
            return f"nothing was heard yet of {self.device}/{self.stream}"
        if not reading.age_s <= self.stale_s:
            return f"{self.device}/{self.stream} is silent"
        value = reading.values.get(self.field)
        if value is None or not math.isfinite(value):
            return f"{self.device}/{self.stream} does not say '{self.field}'"
        return self.condition if self._met(value) else None

    def _met(self, value: float) -> bool:
        if self.above is not None:
            return value > self.above
        if self.below is not None:
            return value < self.below
        return value == self.equals


Restrict = Callable[[str, float, str], None]
"""``Controller.restrict``: source, share of speed left, why."""


@dataclass(slots=True)
class _Watched:
    """One rule and what it did last: why it acts, ``None`` where it does not, ``""`` before it was first looked at."""

    rule: Interlock
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
        rules: Sequence[Interlock],
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
            why = watched.rule.acts(self._room.read(source))
            if why != watched.why:
                self._change(watched, why, now_s)

    def _change(self, watched: _Watched, why: str | None, now_s: float) -> None:
        rule, before = watched.rule, watched.why
        if why is not None:
            self._restrict(rule.name, rule.left, why)
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
