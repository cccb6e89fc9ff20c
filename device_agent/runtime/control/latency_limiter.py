"""Speed limit of streamed setpoints by telemetry round-trip age (loop age).

The operator cannot correct motion before the picture has arrived, the watchdog has reacted and the brakes have worked.
The path that the device would take in that time at its present velocity must be clear.
"""

import math
from collections.abc import Sequence

from device_agent.ports.geometry import RobotGeometry

LIMITED = "speed: loop age"
"""Name of this limit in telemetry."""
_SMOOTHING = 0.2
"""Weight of the newest loop age: one late message is not a slow link."""
_CHECK_PERIODS = 4
"""Periods between two clearance checks."""
_LAG_S = 0.1
"""Delay between a clearance check and the slower motion: check interval and jerk limit [s]."""
_LOOKAHEAD = 1.25
"""Factor of the look-ahead time over the time needed, so that a limit can rise again."""
_CREEP_RAD_S = 0.02
"""Lowest limit, so that a target near an obstacle is reached; the clearance check stops the motion in time [rad/s]."""
_FULL_SPEED_AGE_S = 0.1
"""Loop age up to which a robot of unknown shape keeps its full speed; then the speed falls linearly [s]."""
_MIN_SHARE = 0.1


class LatencyLimiter:
    """Speed limit of streamed motion. Not thread-safe: the controller locks.

    Args:
        geometry: Shape of the robot, if known.
        watchdog_s: Time within which missing setpoints are detected and the device has braked [s].
        max_age_s: Loop age at which a setpoint is rejected [s].
    """

    def __init__(self, geometry: RobotGeometry | None, *, watchdog_s: float, max_age_s: float) -> None:
        self._geometry = geometry
        self._watchdog_s = watchdog_s
        self._max_age_s = max_age_s
        self._age_s: float | None = None
        self._periods = 0
        self._cap_rad_s = math.inf

    def reset(self) -> None:
        """Discard the loop age of the previous operator."""
        self._age_s = None
        self._cap_rad_s = math.inf

    def add_age(self, age_s: float) -> None:
        """Add the loop age of a setpoint [s]."""
        self._age_s = age_s if self._age_s is None else self._age_s + _SMOOTHING * (age_s - self._age_s)

    @property
    def age_s(self) -> float:
        """Smoothed loop age [s]."""
        return self._age_s or 0.0

    def joint_share(self) -> float:
        """Share of the joint speed that the age alone allows, 0…1; 1 if the shape of the robot is known."""
        return 1.0 if self._geometry is not None else self.unchecked_share()

    def unchecked_share(self) -> float:
        """Share of the speed of motion without a clearance check, such as that of a base, 0…1."""
        if self.age_s <= _FULL_SPEED_AGE_S:
            return 1.0
        return max(_MIN_SHARE, (self._max_age_s - self.age_s) / (self._max_age_s - _FULL_SPEED_AGE_S))

    def cap_rad_s(self, position_rad: Sequence[float], velocity_rad_s: Sequence[float], braking_s: float) -> float:
        """Speed limit of every joint [rad/s]: v <= clearance / (loop age + watchdog + braking time).

        The clearance is the length of the clear path at the present velocity.

        Args:
            position_rad: Commanded, shape (n,) [rad].
            velocity_rad_s: Commanded, shape (n,) [rad/s].
            braking_s: Present braking time [s].
        """
        self._periods += 1
        if self._geometry is None or self._periods % _CHECK_PERIODS:
            return self._cap_rad_s
        fastest = max(map(abs, velocity_rad_s), default=0.0)
        if not fastest:  # at rest, the path is clear
            self._cap_rad_s = math.inf
            return self._cap_rad_s
        reaction_s = self.age_s + self._watchdog_s + braking_s + _LAG_S
        ahead_s = _LOOKAHEAD * reaction_s
        end = [position + velocity * ahead_s for position, velocity in zip(position_rad, velocity_rad_s, strict=True)]
        share = self._geometry.glance(position_rad, end)
        self._cap_rad_s = math.inf if share >= 1.0 else max(_CREEP_RAD_S, fastest * share * ahead_s / reaction_s)
        return self._cap_rad_s
