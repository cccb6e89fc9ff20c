"""What the room allows at this moment: from several sources, the strictest counts."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Restriction:
    """How fast a device may move, and who says so.

    Attributes:
        source: Who says so; each source has one word.
        speed: Share of the speed that it would have, 0…1; 0 means hold.
        why: For people.
    """

    source: str
    speed: float
    why: str

    @property
    def text(self) -> str:
        """As ``limited`` names it."""
        return f"interlock: {self.why}"[:200]


class Restrictions:
    """The restrictions of one device. Not thread-safe: its owner locks."""

    def __init__(self) -> None:
        self._by_source: dict[str, Restriction] = {}

    def set(self, source: str, speed: float, why: str) -> None:
        """Take in the newest word of a source. A speed that is no number from 0 to 1 means hold."""
        if not math.isfinite(speed) or not 0.0 <= speed <= 1.0:
            speed = 0.0
        self._by_source[source] = Restriction(source, speed, why)

    def lift(self, source: str) -> None:
        """A source restricts no more."""
        self._by_source.pop(source, None)

    @property
    def all(self) -> tuple[Restriction, ...]:
        """Those in force, the strictest first."""
        return tuple(sorted(self._by_source.values(), key=lambda one: (one.speed, one.source)))

    @property
    def strictest(self) -> Restriction | None:
        """The one that counts."""
        return next(iter(self.all), None)

    @property
    def speed(self) -> float:
        """The share of speed that is left."""
        return min((one.speed for one in self._by_source.values()), default=1.0)
