"""Speed restrictions from several sources; the strictest applies."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Restriction:
    """Speed limit that one source sets.

    Attributes:
        source: Name of the source. Each source has one restriction at a time.
        speed: Share of the normal speed, 0…1; 0 means hold.
        why: Reason, for operators.
    """

    source: str
    speed: float
    why: str

    @property
    def text(self) -> str:
        """Name of the restriction in the telemetry field ``limited``."""
        return f"interlock: {self.why}"[:200]


class Restrictions:
    """Restrictions of one device. Not thread-safe: the controller locks."""

    def __init__(self) -> None:
        self._by_source: dict[str, Restriction] = {}

    def set(self, source: str, speed: float, why: str) -> None:
        """Replace the restriction of a source. A speed outside 0…1 means hold."""
        if not math.isfinite(speed) or not 0.0 <= speed <= 1.0:
            speed = 0.0
        self._by_source[source] = Restriction(source, speed, why)

    def clear(self, source: str) -> None:
        """Remove the restriction of a source."""
        self._by_source.pop(source, None)

    @property
    def all(self) -> tuple[Restriction, ...]:
        """Restrictions in force, the strictest first."""
        return tuple(sorted(self._by_source.values(), key=lambda restriction: (restriction.speed, restriction.source)))

    @property
    def strictest(self) -> Restriction | None:
        """The restriction that applies."""
        return next(iter(self.all), None)

    @property
    def speed(self) -> float:
        """Share of the speed that remains."""
        return min((restriction.speed for restriction in self._by_source.values()), default=1.0)
