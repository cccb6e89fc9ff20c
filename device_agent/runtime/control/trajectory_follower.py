"""Time-scaled execution of a trajectory: follows it at a share of its speed, and brakes without leaving its path."""

import math
from collections.abc import Sequence

import numpy as np

from device_agent.runtime.planning.trajectory import Floats, Trajectory

_EASE_S = 0.25
"""Time constant of a change of the share, except when braking [s]."""
_KNOT_S = 0.04
"""Between knots this far apart in time the path is straight to within 4 mm [s]."""
_BRAKING_MARGIN = 1.5
"""Factor of the braking time for trajectories that bend or slow down meanwhile."""
_ACCELERATION_MARGIN = 0.95
"""The acceleration demand between two periods differs by up to this factor from the demand at their start."""
_REST = 1e-6
_EPSILON = 1e-9


class TrajectoryFollower:
    """Progress of a device on a trajectory. Not thread-safe.

    Args:
        trajectory: From rest to rest.
        period_s: The control period [s].
        acceleration_rad_s2: Acceleration limit of each joint except when braking, shape (n,).
        jerk_rad_s3: Jerk limit of each joint when its speed changes, shape (n,).
        braking_rad_s2: Deceleration limit of every joint when braking.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        *,
        period_s: float,
        acceleration_rad_s2: Sequence[float],
        jerk_rad_s3: Sequence[float],
        braking_rad_s2: float,
    ) -> None:
        self.trajectory = trajectory
        self._period_s = period_s
        self._acceleration_limits = np.array(acceleration_rad_s2)
        self._jerk_limits = np.array(jerk_rad_s3)
        self._braking_limits = np.maximum(_ACCELERATION_MARGIN * braking_rad_s2, self._acceleration_limits)
        self._time_s, self._share, self._change = 0.0, -1.0, 0.0
        self._target_share, self._braking = 0.0, False
        self._next: tuple[float, float, float] | None = None
        self.position_rad = trajectory.position_rad[0]
        self.velocity_rad_s = np.zeros(len(self._acceleration_limits))

    def follow(self, share: float) -> None:
        """Continue at a share of the trajectory's speed, 0…1."""
        self._target_share, self._braking, self._next = share, False, None
        if self._share < 0:  # the trajectory itself starts at rest
            self._share = share

    def brake(self) -> None:
        """Brake to rest on the path at the robot type's deceleration."""
        if not self._braking:
            self._target_share, self._braking, self._next = 0.0, True, None

    @property
    def arrived(self) -> bool:
        """Whether it rests at the end of the trajectory."""
        return self._time_s >= self.trajectory.duration_s

    @property
    def resting(self) -> bool:
        """Whether it rests, at the end or after braking."""
        return self.arrived or (self._braking and self._share <= _REST)

    def propose(self) -> list[list[float]]:
        """Present position, position after one period, then positions up to where braking would end."""
        self._next = time_s, share, _ = self._advance(self._period_s)
        fastest = float(np.max(np.abs(self.trajectory.at(time_s)[1]), initial=0.0)) * share
        ahead_s = share * _BRAKING_MARGIN * (fastest / float(np.min(self._braking_limits)) + self._period_s)
        knots = max(1, math.ceil(ahead_s / _KNOT_S))
        times = [time_s, *(time_s + ahead_s * (index + 1) / knots for index in range(knots))]
        return [self.position_rad.tolist(), *(self.trajectory.at(time)[0].tolist() for time in times)]

    def update(self, elapsed_s: float | None = None) -> None:
        """Advance one period, as proposed if it was, or ``elapsed_s`` of it [s]."""
        self._time_s, self._share, self._change = self._next or self._advance(elapsed_s or self._period_s)
        self._next = None
        position, velocity, _ = self.trajectory.at(self._time_s)
        self.position_rad, self.velocity_rad_s = position, velocity * max(self._share, 0.0)

    def catch_up(self, lost_s: float) -> None:
        """Reduce the speed as if the device had braked for ``lost_s`` [s]; the position is unchanged."""
        lower, _ = self._change_limits(self._braking_limits)
        self._share, self._next = max(0.0, self._share + lower * lost_s), None
        self.velocity_rad_s = self.trajectory.at(self._time_s)[1] * self._share

    def _advance(self, elapsed_s: float) -> tuple[float, float, float]:
        """Trajectory time, share and change of the share after ``elapsed_s``."""
        current = max(self._share, 0.0)
        if self._braking:
            change = max(self._change_limits(self._braking_limits)[0], -current / elapsed_s)
        else:
            lower, upper = self._change_limits(self._acceleration_limits)
            speed = np.maximum(np.abs(self.trajectory.at(self._time_s)[1]), _EPSILON)
            ramp = elapsed_s * float(np.min(self._jerk_limits / speed))
            eased = (self._target_share - current) / _EASE_S
            change = min(max(min(max(eased, self._change - ramp), self._change + ramp), lower), upper)
        share = min(max(current + change * elapsed_s, 0.0), max(current, self._target_share))
        return self._time_s + (current + share) / 2 * elapsed_s, share, change

    def _change_limits(self, limit: Floats) -> tuple[float, float]:
        """Lowest and highest change of the share that keeps each joint within an acceleration limit [1/s]."""
        _, velocity, acceleration = self.trajectory.at(self._time_s)
        current = max(self._share, 0.0)
        speed = np.maximum(np.abs(velocity), _EPSILON)
        along = acceleration * np.sign(velocity) * current**2
        return min(0.0, float(np.max((-limit - along) / speed))), max(0.0, float(np.min((limit - along) / speed)))
