"""Goes along a way, one control period at a time, at a share of its speed; brakes without leaving it."""

import math
from collections.abc import Sequence

import numpy as np

from device_agent.runtime.planning.trajectory import Floats, Trajectory

_EASE_S = 0.25
"""Time constant of a change of the share, where nothing has to brake."""
_KNOT_S = 0.04
"""As for braking off a way: between knots this far apart it is straight to within 4 mm."""
_SLACK = 1.5
"""How much longer than at full braking a way may need that bends or slows down meanwhile."""
_CAUTION = 0.95
"""What a way asks between two periods differs by so much from what it asks at their beginning."""
_REST = 1e-6
_NOTHING = 1e-9


class TrajectoryFollower:
    """How far a device has come on a way. Not thread-safe.

    Args:
        way: From rest to rest.
        period_s: The control period [s].
        acceleration_rad_s2: What no joint exceeds while it goes on, shape (n,).
        jerk_rad_s3: As fast its acceleration changes when its speed is changed, shape (n,).
        braking_rad_s2: What no joint exceeds while it brakes.
    """

    def __init__(
        self,
        way: Trajectory,
        *,
        period_s: float,
        acceleration_rad_s2: Sequence[float],
        jerk_rad_s3: Sequence[float],
        braking_rad_s2: float,
    ) -> None:
        self.way = way
        self._period_s = period_s
        self._easy = np.array(acceleration_rad_s2)
        self._jerk = np.array(jerk_rad_s3)
        self._hard = np.maximum(_CAUTION * braking_rad_s2, self._easy)
        self._time_s, self._share, self._change = 0.0, -1.0, 0.0
        self._aim, self._braking = 0.0, False
        self._next: tuple[float, float, float] | None = None
        self.position_rad, self.velocity_rad_s = way.position_rad[0], np.zeros(len(self._easy))

    def go(self, share: float) -> None:
        """Go on, at a share of the way's speed, 0…1."""
        self._aim, self._braking, self._next = share, False, None
        if self._share < 0:  # the way itself begins at rest
            self._share = share

    def brake(self) -> None:
        """Come to rest on the way as fast as the robot type allows."""
        if not self._braking:
            self._aim, self._braking, self._next = 0.0, True, None

    @property
    def arrived(self) -> bool:
        """Whether it rests at the way's end."""
        return self._time_s >= self.way.duration_s

    @property
    def resting(self) -> bool:
        """Whether it rests: at the end, or where it was braked."""
        return self.arrived or (self._braking and self._share <= _REST)

    def propose(self) -> list[list[float]]:
        """Where it is, where it would be a period on, then places as far as it could need to come to rest."""
        self._next = time_s, share, _ = self._step(self._period_s)
        fastest = float(np.max(np.abs(self.way.at(time_s)[1]), initial=0.0)) * share
        ahead_s = share * _SLACK * (fastest / float(np.min(self._hard)) + self._period_s)
        knots = max(1, math.ceil(ahead_s / _KNOT_S))
        places = [time_s, *(time_s + ahead_s * (index + 1) / knots for index in range(knots))]
        return [self.position_rad.tolist(), *(self.way.at(place)[0].tolist() for place in places)]

    def update(self, passed_s: float | None = None) -> None:
        """Advance one period, as proposed if it was; or by what has passed of one [s]."""
        self._time_s, self._share, self._change = self._next or self._step(passed_s or self._period_s)
        self._next = None
        position, velocity, _ = self.way.at(self._time_s)
        self.position_rad, self.velocity_rad_s = position, velocity * max(self._share, 0.0)

    def make_up(self, lost_s: float) -> None:
        """Count time in which no period was commanded as braked; it stays where it is, only the speed falls."""
        least, _ = self._changes(self._hard)
        self._share, self._next = max(0.0, self._share + least * lost_s), None
        self.velocity_rad_s = self.way.at(self._time_s)[1] * self._share

    def _step(self, passed_s: float) -> tuple[float, float, float]:
        """Time on the way, share and its change so much later."""
        now = max(self._share, 0.0)
        if self._braking:
            change = max(self._changes(self._hard)[0], -now / passed_s)
        else:
            least, most = self._changes(self._easy)
            speed = np.maximum(np.abs(self.way.at(self._time_s)[1]), _NOTHING)
            ramp = passed_s * float(np.min(self._jerk / speed))
            wanted = min(max((self._aim - now) / _EASE_S, self._change - ramp), self._change + ramp)
            change = min(max(wanted, least), most)
        share = min(max(now + change * passed_s, 0.0), max(now, self._aim))
        return self._time_s + (now + share) / 2 * passed_s, share, change

    def _changes(self, limit: Floats) -> tuple[float, float]:
        """How fast the share may fall and rise so that no joint exceeds an acceleration [1/s]."""
        _, velocity, acceleration = self.way.at(self._time_s)
        now = max(self._share, 0.0)
        speed = np.maximum(np.abs(velocity), _NOTHING)
        along = acceleration * np.sign(velocity) * now**2
        return min(0.0, float(np.max((-limit - along) / speed))), max(0.0, float(np.min((limit - along) / speed)))
