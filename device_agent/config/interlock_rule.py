"""Interlock settings of ``agent.toml``. ``device_agent.runtime.authority.interlocks`` evaluates them."""

import math
from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.protocol import Field, Id, InterlockDescription


class InterlockRule(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[devices.interlocks]]`` of ``agent.toml``. Exactly one of ``above``, ``below`` and ``equals`` is set.

    Attributes:
        device: Id of a device of the same space, or the name of a device of this agent.
        stream: Stream of that device.
        field: Field of the stream that is compared.
        above: The interlock engages while the value is greater.
        below: The interlock engages while the value is less.
        equals: The interlock engages while the value is equal.
        action: ``hold`` stops motion; ``slow`` scales the speed limits.
        speed: Remaining share of the speed limits for ``slow``.
        stale_s: The interlock also engages when the newest value is older than this [s].
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
        """Check the condition.

        Raises:
            ValueError: There is not exactly one condition, or its number is not finite.
        """
        conditions = [value for value in (self.above, self.below, self.equals) if value is not None]
        if len(conditions) != 1:
            raise ValueError(f"the interlock on '{self.field}' needs exactly one of above, below, equals")
        if not math.isfinite(conditions[0]):
            raise ValueError(f"the interlock on '{self.field}' needs a finite number")

    @property
    def name(self) -> str:
        """Name in ``state``, ``desc`` and events: device, stream and condition."""
        return f"{self.device}/{self.stream} {self.condition}"

    @property
    def condition(self) -> str:
        """The condition as text."""
        if self.above is not None:
            return f"{self.field} > {self.above:g}"
        if self.below is not None:
            return f"{self.field} < {self.below:g}"
        return f"{self.field} = {str(self.equals).lower()}"

    @property
    def remaining_speed(self) -> float:
        """Share of the speed limits that remains while the interlock is engaged; 0 for ``hold``."""
        return 0.0 if self.action == "hold" else self.speed

    @property
    def description(self) -> InterlockDescription:
        """The rule as ``desc`` publishes it."""
        stale_ms = round(self.stale_s * 1000)
        return InterlockDescription(name=self.name, action=self.action, speed=self.remaining_speed, stale_ms=stale_ms)
