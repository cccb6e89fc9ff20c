"""How fast streamed setpoints may move the device, by how old the operator's picture of it is.

Nobody corrects what the device does before the picture has come, the watchdog has noticed and the brakes have worked.
What it would do in that time, going on as it goes now, must be clear.
"""

import math
from collections.abc import Sequence

from device_agent.ports.geometry import RobotGeometry

LIMITED = "speed: loop age"
"""As ``limited`` names it."""
_SMOOTHING = 0.2
"""Weight of the newest loop age: one late answer is not a slow link."""
_EVERY = 4
"""Periods between two looks ahead."""
_LAG_S = 0.1
"""Slowing down follows what is seen by so much: a look every fourth period, and the jerk limit."""
_AHEAD = 1.25
"""How much further than needed it looks, so that a limit can also rise again."""
_CREEP_RAD_S = 0.02
"""Never slower than this, so that a target close to something is reached; the brakes hold before the margin."""
_EASY_S = 0.1
"""Up to this loop age nothing is slowed where nobody knows the robot's shape; from there on in proportion."""
_LEAST_SHARE = 0.1


class LatencyLimiter:
    """The speed limit of streamed motion. Not thread-safe: its owner locks.

    Args:
        geometry: The robot's shape, if it is known.
        watchdog_s: Time in which missing setpoints are noticed and answered [s].
        oldest_s: A setpoint of this age is refused [s].
    """

    def __init__(self, geometry: RobotGeometry | None, *, watchdog_s: float, oldest_s: float) -> None:
        self._geometry = geometry
        self._watchdog_s = watchdog_s
        self._oldest_s = oldest_s
        self._age_s: float | None = None
        self._periods = 0
        self._cap_rad_s = math.inf

    def begin(self) -> None:
        """A new operator; what was known of the link of the one before is forgotten."""
        self._age_s = None
        self._cap_rad_s = math.inf

    def heard(self, age_s: float) -> None:
        """A setpoint came with this loop age [s]."""
        self._age_s = age_s if self._age_s is None else self._age_s + _SMOOTHING * (age_s - self._age_s)

    @property
    def age_s(self) -> float:
        """The loop age, smoothed [s]."""
        return self._age_s or 0.0

    def share(self) -> float:
        """What age alone leaves of the speed where nobody knows what the robot could touch, 0…1."""
        return 1.0 if self._geometry is not None else self.blind_share()

    def blind_share(self) -> float:
        """What age alone leaves of the speed of what nobody looks ahead for, as a base, 0…1."""
        if self.age_s <= _EASY_S:
            return 1.0
        return max(_LEAST_SHARE, (self._oldest_s - self.age_s) / (self._oldest_s - _EASY_S))

    def cap_rad_s(self, position_rad: Sequence[float], velocity_rad_s: Sequence[float], braking_s: float) -> float:
        """What no joint may exceed now [rad/s]: v <= clearance / (loop age + watchdog + braking time).

        The clearance is the way that is clear when the device goes on as it goes.

        Args:
            position_rad: Commanded, shape (n,) [rad].
            velocity_rad_s: Commanded, shape (n,) [rad/s].
            braking_s: How long it would brake [s].
        """
        self._periods += 1
        if self._geometry is None or self._periods % _EVERY:
            return self._cap_rad_s
        fastest = max(map(abs, velocity_rad_s), default=0.0)
        if not fastest:  # going on as it goes, it stays: all of that way is clear
            self._cap_rad_s = math.inf
            return self._cap_rad_s
        blind_s = self.age_s + self._watchdog_s + braking_s + _LAG_S
        ahead_s = _AHEAD * blind_s
        end = [position + velocity * ahead_s for position, velocity in zip(position_rad, velocity_rad_s, strict=True)]
        share = self._geometry.glance(position_rad, end)
        self._cap_rad_s = math.inf if share >= 1.0 else max(_CREEP_RAD_S, fastest * share * ahead_s / blind_s)
        return self._cap_rad_s
