"""Jerk-limited motion of the joints of one device, one control period at a time (``ruckig``)."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from ruckig import ControlInterface, InputParameter, OutputParameter, Result, Ruckig, RuckigError, Synchronization
from ruckig import Trajectory as RuckigTrajectory

from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.trajectory_follower import TrajectoryFollower
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.trajectory import Trajectory

_BRAKING_RAMP_S = 0.01
"""Time in which braking reaches its full deceleration: short compared with the 50 ms limit of a hold [s]."""
_KNOT_S = 0.04
"""Between knots this far apart in time a braking path is straight to within 4 mm at any speed in use [s]."""
_SLOWDOWN_SAMPLES = 4
"""Samples of a slowdown; a joint that reverses does so between two of them."""
_REST_RAD_S = 1e-6
_ROUNDING = 1e-12
_REDUCED_SPEED = 0.999
_ACCELERATION_SHARE = 0.9997
"""Share of the acceleration limit that a motion uses. For a motion of 2 a³/j², which only just reaches it, ``ruckig``
0.19 finds no trajectory, or one of many minutes. Round limits and positions make that likely; this share does not.
"""
_REACHED_RAD = 1e-4
_SAME_RAD_S2 = 1e-3


class MotionError(Exception):
    """The trajectory generator found no trajectory; the device must hold."""


def generate(calculate: Callable[[Any, Any], Result], request: InputParameter, output: Any) -> None:
    """Call ``ruckig``, and retry once at a slightly lower speed.

    If a joint reaches its speed and acceleration limits at the same moment, rounding can hide every solution.

    Raises:
        MotionError: No trajectory was found.
    """
    try:
        result = calculate(request, output)
    except RuckigError:
        fastest = request.max_velocity
        request.max_velocity = [_REDUCED_SPEED * limit for limit in fastest]
        try:
            result = calculate(request, output)
        except RuckigError as error:
            raise MotionError(f"no trajectory from the present state: {error}") from error
        finally:
            request.max_velocity = fastest
    if result not in (Result.Working, Result.Finished):
        raise MotionError(f"no trajectory from the present state ({result})")


class JointMotion:
    """Commanded position and velocity of each joint.

    Attributes:
        waits: Joints that wait for other joints, as ``limited`` names them.
    """

    def __init__(self, robot_type: RobotType) -> None:
        joints = robot_type.joints
        self._period_s = robot_type.period_ms / 1000
        self._velocity_limits = [joint.max_velocity_rad_s for joint in joints]
        self._acceleration_limits = [joint.max_acceleration_rad_s2 for joint in joints]
        self._used_rad_s2 = [_ACCELERATION_SHARE * limit for limit in self._acceleration_limits]
        self._jerk_limits = [joint.max_jerk_rad_s3 for joint in joints]
        self._braking = robot_type.braking_rad_s2
        self._generator = Ruckig(len(joints), self._period_s)
        self._input = InputParameter(len(joints))
        self._output = OutputParameter(len(joints))
        self._target: list[float] = [0.0] * len(joints)
        self._zeros = [0.0] * len(joints)
        self._planner = Ruckig(len(joints))
        self._plan = RuckigTrajectory(len(joints))
        self._plan_input = InputParameter(len(joints))
        self._proposed = False
        self._follower: TrajectoryFollower | None = None
        self._couplings = Couplings(robot_type)
        self._tracked: dict[int, float] = {}
        self.waits: tuple[str, ...] = ()
        self.braking = True
        self.position_rad: list[float] = [0.0] * len(joints)
        self.velocity_rad_s: list[float] = [0.0] * len(joints)
        self.start_at(self.position_rad)

    def start_at(self, position_rad: Sequence[float]) -> None:
        """Start at rest at ``position_rad``, shape (n,) [rad]."""
        self.position_rad = list(position_rad)
        self.velocity_rad_s = list(self._zeros)
        self._input.current_position = self.position_rad
        self._input.current_velocity = self._zeros
        self._input.current_acceleration = self._zeros
        self._proposed = False
        self._follower = None
        self.brake()

    def follow(
        self,
        target_rad: Sequence[float],
        *,
        speed: float = 1.0,
        cap_rad_s: float = math.inf,
        max_rad_s: Sequence[float] | None = None,
        together: bool = False,
    ) -> None:
        """Move towards ``target_rad``, shape (n,) [rad], which is inside the joints' ranges.

        A joint that brakes harder than ordinary jerk can end in time continues to brake: otherwise it would reverse.
        A device on a trajectory first brakes to rest on it.

        Args:
            target_rad: Positions at which to come to rest.
            speed: Share of each joint's velocity limit, above 0 and at most 1.
            cap_rad_s: Speed limit of every joint.
            max_rad_s: Additional speed limit of each joint, shape (n,), above 0.
            together: True: all joints arrive at the same time. False: each joint is as fast as it can be.
        """
        self._target = list(target_rad)
        for index, measured in self._tracked.items():
            self._target[index] = measured
        if self._follower is not None:
            self.brake()
            return
        if self.braking and self._would_reverse():
            return
        self.braking = False
        self._input.control_interface = ControlInterface.Position
        self._input.synchronization = Synchronization.Time if together else Synchronization.No
        fastest = [min(limit * speed, cap_rad_s) for limit in self._velocity_limits]
        if max_rad_s is not None:
            fastest = [min(pair) for pair in zip(fastest, max_rad_s, strict=True)]
        self._input.max_velocity = fastest
        self._input.max_acceleration = self._used_rad_s2
        self._input.max_jerk = self._jerk_limits
        self._input.target_position = self._period_target()
        self._input.target_velocity = self._zeros
        self._input.target_acceleration = self._zeros

    def _would_reverse(self) -> bool:
        """Whether a joint with ordinary jerk would reverse before its deceleration has ended."""
        return any(
            abs(now) > limit + _SAME_RAD_S2
            or (now * velocity <= 0 and now * now > 2 * jerk * abs(velocity) + _SAME_RAD_S2)
            for now, limit, jerk, velocity in zip(
                self._input.current_acceleration,
                self._acceleration_limits,
                self._jerk_limits,
                self.velocity_rad_s,
                strict=True,
            )
        )

    def follow_trajectory(self, trajectory: Trajectory, *, share: float) -> None:
        """Follow a trajectory that starts at the resting position."""
        self._target = trajectory.position_rad[-1].tolist()
        if self._follower is None and not self.moving and self._rests_at(trajectory.position_rad[0].tolist()):
            self._follower = TrajectoryFollower(
                trajectory,
                period_s=self._period_s,
                acceleration_rad_s2=self._acceleration_limits,
                jerk_rad_s3=self._jerk_limits,
                braking_rad_s2=self._braking,
            )
        if self._follower is None or self._follower.trajectory is not trajectory:
            self.brake()
            return
        self.braking = False
        self._follower.follow(share)

    def _rests_at(self, position_rad: Sequence[float]) -> bool:
        """Whether the device rests at the start of a trajectory; otherwise the first period would be a jump."""
        pairs = zip(self.position_rad, position_rad, strict=True)
        return all(abs(a - b) <= _REACHED_RAD or index in self._tracked for index, (a, b) in enumerate(pairs))

    def _period_target(self) -> list[float]:
        """The target of this period. Coupled joints that would violate each other's range wait."""
        if not self._couplings:
            return self._target
        request = self._plan_from_present()
        self._set_slowdown(request, self._acceleration_limits, self._jerk_limits)
        generate(self._planner.calculate, request, self._plan)
        parts = [part / _SLOWDOWN_SAMPLES for part in range(_SLOWDOWN_SAMPLES + 1)]
        samples = [self._plan.at_time(self._plan.duration * part)[0] for part in parts]
        swing = [(min(of_joint), max(of_joint)) for of_joint in zip(*samples, strict=True)]
        target, self.waits = self._couplings.limit_target(self._target, self.position_rad, swing)
        return target

    def _plan_from_present(self) -> InputParameter:
        request = self._plan_input
        request.current_position = self._input.current_position
        request.current_velocity = self._input.current_velocity
        request.current_acceleration = self._input.current_acceleration
        return request

    def brake(self) -> None:
        """Brake to rest at the robot type's deceleration; a device on a trajectory stays on its path."""
        if not self.braking:
            self._proposed = False
        self.braking = True
        self.waits = ()
        if self._follower is not None:
            self._follower.brake()
        self._set_braking(self._input)

    def _set_braking(self, request: InputParameter) -> None:
        count = len(self._zeros)
        self._set_slowdown(request, [self._braking] * count, [self._braking / _BRAKING_RAMP_S] * count)

    def _set_slowdown(self, request: InputParameter, acceleration: list[float], jerk: list[float]) -> None:
        request.control_interface = ControlInterface.Velocity
        request.synchronization = Synchronization.No
        request.max_velocity = self._velocity_limits
        request.max_acceleration = acceleration
        request.max_jerk = jerk
        request.target_velocity = self._zeros
        request.target_acceleration = self._zeros

    def propose(self) -> list[list[float]]:
        """Plan one period, and the braking after it.

        Nothing moves until ``update``; a ``brake`` in between discards the plan.

        Returns:
            Positions along that path, (n,) [rad] each: now, after the period, then until rest.

        Raises:
            MotionError: The generator found no trajectory.
        """
        if self._follower is not None:
            return self._follower.propose()
        if not self._zeros:  # ``ruckig`` cannot plan without joints
            return [[], []]
        generate(self._generator.update, self._input, self._output)
        self._proposed = True
        request = self._plan_input
        request.current_position = self._output.new_position
        request.current_velocity = self._output.new_velocity
        request.current_acceleration = self._output.new_acceleration
        self._set_braking(request)
        generate(self._planner.calculate, request, self._plan)
        knots = max(1, math.ceil(self._plan.duration / _KNOT_S))
        ahead = [self._plan.at_time(self._plan.duration * (index + 1) / knots)[0] for index in range(knots)]
        return [list(self.position_rad), list(self._output.new_position), *(list(knot) for knot in ahead)]

    def update(self, elapsed_s: float | None = None) -> list[float]:
        """Advance one period, as proposed if it was, or ``elapsed_s`` of a period without a proposal.

        Returns:
            The position to command now, shape (n,) [rad].

        Raises:
            MotionError: The generator found no trajectory; position and velocity are unchanged.
        """
        if self._follower is not None:
            return self._update_follower(self._follower, elapsed_s)
        if not self._zeros:
            return self.position_rad
        if not self._proposed:
            self._generator.delta_time = elapsed_s or self._period_s
            try:
                generate(self._generator.update, self._input, self._output)
            finally:
                self._generator.delta_time = self._period_s
        self._proposed = False
        self._output.pass_to_input(self._input)
        before = self.position_rad
        self.position_rad = list(self._output.new_position)
        # A velocity from rounding counts as rest: from it, ``ruckig`` may find no trajectory.
        self.velocity_rad_s = [0.0 if abs(value) < _ROUNDING else value for value in self._output.new_velocity]
        self._input.current_velocity = self.velocity_rad_s
        self._apply_couplings(before)
        return self.position_rad

    def _update_follower(self, follower: TrajectoryFollower, elapsed_s: float | None) -> list[float]:
        follower.update(elapsed_s)
        before = self.position_rad
        self.position_rad, self.velocity_rad_s = follower.position_rad.tolist(), follower.velocity_rad_s.tolist()
        self._apply_couplings(before)
        if follower.resting:
            self.start_at(self.position_rad)
        return self.position_rad

    def _apply_couplings(self, before_rad: Sequence[float]) -> None:
        """Correct coupled and compliant joints, which the generator does not know."""
        if not self._couplings and not self._tracked:
            return
        acceleration = list(self._input.current_acceleration)
        for index, measured in self._tracked.items():
            self.position_rad[index] = measured
            self.velocity_rad_s[index] = acceleration[index] = 0.0
        self._couplings.clamp_to_range(self.position_rad, before_rad)
        for values in (self.position_rad, self.velocity_rad_s, acceleration):
            self._couplings.apply_mirrors(values)
        self._input.current_position = self.position_rad
        self._input.current_velocity = self.velocity_rad_s
        self._input.current_acceleration = acceleration

    def track_measured(self, measured_rad: dict[int, float]) -> None:
        """Command compliant joints to their measured positions, so that they do not jump when they stiffen.

        Args:
            measured_rad: Index of each compliant joint → its position, inside its range [rad].
        """
        self._tracked = measured_rad

    def catch_up(self, lost_s: float) -> None:
        """Reduce the velocity as if the device had braked for ``lost_s``; the position is unchanged."""
        if self._follower is not None:
            self._follower.catch_up(lost_s)
            self.velocity_rad_s = self._follower.velocity_rad_s.tolist()
            return
        request = self._plan_from_present()
        self._set_braking(request)
        generate(self._planner.calculate, request, self._plan)
        _, velocity, acceleration = self._plan.at_time(min(lost_s, self._plan.duration))
        self._input.current_velocity = velocity
        self._input.current_acceleration = acceleration
        self.velocity_rad_s = list(velocity)

    @property
    def moving(self) -> bool:
        """Whether any commanded velocity is not zero."""
        return self.fastest_rad_s > _REST_RAD_S

    @property
    def fastest_rad_s(self) -> float:
        """The highest commanded speed among the joints [rad/s]."""
        return max((abs(velocity) for velocity in self.velocity_rad_s), default=0.0)

    @property
    def reached(self) -> bool:
        """Whether the device rests at the last target."""
        near = all(abs(a - b) <= _REACHED_RAD for a, b in zip(self.position_rad, self._target, strict=True))
        return near and not self.moving

    def max_speed_rad_s(self, speed: float) -> float:
        """Highest speed limit of the joints at a share of it [rad/s]."""
        return max(self._velocity_limits, default=0.0) * speed

    def braking_time_s(self) -> float:
        """Braking time from the present velocity [s], including the ramps at both ends."""
        return self.fastest_rad_s / self._braking + 3 * _BRAKING_RAMP_S
