"""Jerk-limited motion of all joints of one device, one control period at a time (``ruckig``)."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from ruckig import (
    ControlInterface,
    InputParameter,
    OutputParameter,
    Result,
    Ruckig,
    RuckigError,
    Synchronization,
)
from ruckig import (
    Trajectory as RuckigTrajectory,
)

from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.trajectory_follower import TrajectoryFollower
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.trajectory import Trajectory

_BRAKING_RAMP_S = 0.01
"""Time in which braking reaches its full deceleration: short against the 50 ms in which a hold must be complete."""
_KNOT_S = 0.04
"""Between knots this far apart in time a braking path is straight to within 4 mm at any speed in use."""
_LOOKS = 4
"""Parts of a slowing down after which is looked where it has led: what turns on its way is between two of them."""
_REST_RAD_S = 1e-6
_ROUNDING = 1e-12
_LITTLE_LESS = 0.999
_REACHED_RAD = 1e-4
_SAME_RAD_S2 = 1e-3


class MotionError(Exception):
    """The trajectory generator refused its input; the device must hold."""


def plan(generate: Callable[[Any, Any], Result], order: InputParameter, answer: Any) -> None:
    """Have ``ruckig`` answer an order.

    Where a joint would meet its greatest speed and acceleration at one moment, and at once leave them, rounding can
    hide every way from it. With a little less speed there is one.

    Raises:
        MotionError: It found nothing.
    """
    try:
        result = generate(order, answer)
    except RuckigError:
        fastest = order.max_velocity
        order.max_velocity = [_LITTLE_LESS * limit for limit in fastest]
        try:
            result = generate(order, answer)
        except RuckigError as error:
            raise MotionError(f"no way to go on from here: {error}") from error
        finally:
            order.max_velocity = fastest
    if result not in (Result.Working, Result.Finished):
        raise MotionError(f"no way to go on from here ({result})")


class JointMotion:
    """The commanded position and velocity of each joint, moved towards a target or to rest.

    Args:
        robot_type: Limits of each joint and the braking deceleration.

    Attributes:
        waits: Which joints wait for which, as ``limited`` names it.
    """

    def __init__(self, robot_type: RobotType) -> None:
        joints = robot_type.joints
        self._period_s = robot_type.period_ms / 1000
        self._velocity_limits = [joint.max_velocity_rad_s for joint in joints]
        self._acceleration_limits = [joint.max_acceleration_rad_s2 for joint in joints]
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
        self._ride: TrajectoryFollower | None = None
        self._couplings = Couplings(robot_type)
        self._limp: dict[int, float] = {}
        self.waits: tuple[str, ...] = ()
        self.braking = True
        self.position_rad: list[float] = [0.0] * len(joints)
        self.velocity_rad_s: list[float] = [0.0] * len(joints)
        self.start_at(self.position_rad)

    def start_at(self, position_rad: Sequence[float]) -> None:
        """Begin at rest at ``position_rad``, shape (n,) [rad]."""
        self.position_rad = list(position_rad)
        self.velocity_rad_s = list(self._zeros)
        self._input.current_position = self.position_rad
        self._input.current_velocity = self._zeros
        self._input.current_acceleration = self._zeros
        self._proposed = False
        self._ride = None
        self.brake()

    def follow(
        self,
        target_rad: Sequence[float],
        *,
        speed: float = 1.0,
        cap_rad_s: float = math.inf,
        most_rad_s: Sequence[float] | None = None,
        together: bool = False,
    ) -> None:
        """Head for ``target_rad``, shape (n,) [rad], already inside the joints' ranges.

        What still brakes harder than with ordinary jerk it could leave off goes on braking: it would run backwards.
        What is on a way comes to rest on it first.

        Args:
            target_rad: Where to come to rest.
            speed: Share of each joint's velocity limit, above 0 and at most 1.
            cap_rad_s: What no joint exceeds.
            most_rad_s: What each joint does not exceed besides, shape (n,), above 0.
            together: Whether all joints arrive at the same time (a move) or each as fast as it can (a slider).
        """
        self._target = list(target_rad)
        for index, measured in self._limp.items():
            self._target[index] = measured
        if self._ride is not None:
            self.brake()
            return
        if self.braking and self._would_turn():
            return
        self.braking = False
        self._input.control_interface = ControlInterface.Position
        self._input.synchronization = Synchronization.Time if together else Synchronization.No
        fastest = [min(limit * speed, cap_rad_s) for limit in self._velocity_limits]
        if most_rad_s is not None:
            fastest = [min(pair) for pair in zip(fastest, most_rad_s, strict=True)]
        self._input.max_velocity = fastest
        self._input.max_acceleration = self._acceleration_limits
        self._input.max_jerk = self._jerk_limits
        self._input.target_position = self._heading()
        self._input.target_velocity = self._zeros
        self._input.target_acceleration = self._zeros

    def _would_turn(self) -> bool:
        """Whether a joint, with ordinary jerk, would run backwards before it has left its deceleration."""
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

    def ride(self, way: Trajectory, *, share: float) -> None:
        """Go along a way that begins where the device rests.

        Args:
            way: Inside the joints' ranges.
            share: Of the way's speed, above 0 and at most 1.
        """
        self._target = way.position_rad[-1].tolist()
        if self._ride is None and not self.moving and self._rests_at(way.position_rad[0].tolist()):
            self._ride = TrajectoryFollower(
                way,
                period_s=self._period_s,
                acceleration_rad_s2=self._acceleration_limits,
                jerk_rad_s3=self._jerk_limits,
                braking_rad_s2=self._braking,
            )
        if self._ride is None or self._ride.way is not way:
            self.brake()
            return
        self.braking = False
        self._ride.go(share)

    def _rests_at(self, position_rad: Sequence[float]) -> bool:
        """Whether a way that begins there begins here: on another one the first period would be a jump."""
        pairs = zip(self.position_rad, position_rad, strict=True)
        return all(abs(a - b) <= _REACHED_RAD or index in self._limp for index, (a, b) in enumerate(pairs))

    def _heading(self) -> list[float]:
        """The target for this period: joints that leave each other no room wait for each other."""
        if not self._couplings:
            return self._target
        order = self._plan_input
        order.current_position = self._input.current_position
        order.current_velocity = self._input.current_velocity
        order.current_acceleration = self._input.current_acceleration
        self._slow_down(order, self._acceleration_limits, self._jerk_limits)
        plan(self._planner.calculate, order, self._plan)
        places = [self._plan.at_time(self._plan.duration * part / _LOOKS)[0] for part in range(_LOOKS + 1)]
        swing = [(min(of_joint), max(of_joint)) for of_joint in zip(*places, strict=True)]
        heading, self.waits = self._couplings.steer(self._target, self.position_rad, swing)
        return heading

    def brake(self) -> None:
        """Come to rest as fast as the robot type allows, and stay there; what is on a way stays on it."""
        if not self.braking:
            self._proposed = False
        self.braking = True
        self.waits = ()
        if self._ride is not None:
            self._ride.brake()
        self._brake(self._input)

    def _brake(self, order: InputParameter) -> None:
        count = len(self._zeros)
        self._slow_down(order, [self._braking] * count, [self._braking / _BRAKING_RAMP_S] * count)

    def _slow_down(self, order: InputParameter, acceleration: list[float], jerk: list[float]) -> None:
        order.control_interface = ControlInterface.Velocity
        order.synchronization = Synchronization.No
        order.max_velocity = self._velocity_limits
        order.max_acceleration = acceleration
        order.max_jerk = jerk
        order.target_velocity = self._zeros
        order.target_acceleration = self._zeros

    def propose(self) -> list[list[float]]:
        """Plan one period, and how the device would come to rest if it braked from there on.

        Nothing moves until ``update``; a ``brake`` in between takes it back.

        Returns:
            Positions along that way, (n,) [rad] each: where it is now, where it would be, then until rest.

        Raises:
            MotionError: The generator found no trajectory.
        """
        if self._ride is not None:
            return self._ride.propose()
        if not self._zeros:  # ``ruckig`` cannot plan for nothing
            return [[], []]
        plan(self._generator.update, self._input, self._output)
        self._proposed = True
        order = self._plan_input
        order.current_position = self._output.new_position
        order.current_velocity = self._output.new_velocity
        order.current_acceleration = self._output.new_acceleration
        self._brake(order)
        plan(self._planner.calculate, order, self._plan)
        knots = max(1, math.ceil(self._plan.duration / _KNOT_S))
        ahead = [self._plan.at_time(self._plan.duration * (index + 1) / knots)[0] for index in range(knots)]
        return [list(self.position_rad), list(self._output.new_position), *(list(knot) for knot in ahead)]

    def update(self, passed_s: float | None = None) -> list[float]:
        """Advance one period, as proposed if it was; or by what has passed of one, of which nothing was proposed.

        Args:
            passed_s: Since the last period began, where this one comes early [s].

        Returns:
            The position to command now, shape (n,) [rad].

        Raises:
            MotionError: The generator found no trajectory; position and velocity are as they were.
        """
        if self._ride is not None:
            return self._update_ride(self._ride, passed_s)
        if not self._zeros:
            return self.position_rad
        if not self._proposed:
            self._generator.delta_time = passed_s or self._period_s
            try:
                plan(self._generator.update, self._input, self._output)
            finally:
                self._generator.delta_time = self._period_s
        self._proposed = False
        self._output.pass_to_input(self._input)
        before = self.position_rad
        self.position_rad = list(self._output.new_position)
        # What is left by rounding is rest: from there, ``ruckig`` may find no way back.
        self.velocity_rad_s = [0.0 if abs(left) < _ROUNDING else left for left in self._output.new_velocity]
        self._input.current_velocity = self.velocity_rad_s
        self._hold_together(before)
        return self.position_rad

    def _update_ride(self, ride: TrajectoryFollower, passed_s: float | None) -> list[float]:
        ride.update(passed_s)
        before = self.position_rad
        self.position_rad, self.velocity_rad_s = ride.position_rad.tolist(), ride.velocity_rad_s.tolist()
        self._hold_together(before)
        if ride.resting:
            self.start_at(self.position_rad)
        return self.position_rad

    def _hold_together(self, before_rad: Sequence[float]) -> None:
        """What the generator does not know: joints that hang together, and joints that are limp."""
        if not self._couplings and not self._limp:
            return
        acceleration = list(self._input.current_acceleration)
        for index, measured in self._limp.items():
            self.position_rad[index] = measured
            self.velocity_rad_s[index] = acceleration[index] = 0.0
        self._couplings.keep(self.position_rad, before_rad)
        for values in (self.position_rad, self.velocity_rad_s, acceleration):
            self._couplings.tie(values)
        self._input.current_position = self.position_rad
        self._input.current_velocity = self.velocity_rad_s
        self._input.current_acceleration = acceleration

    def loosen(self, measured_rad: dict[int, float]) -> None:
        """Command some joints to where they are measured: they are limp, and must not jump once they no longer are.

        Args:
            measured_rad: Index of each such joint → its position, inside its range [rad].
        """
        self._limp = measured_rad

    def make_up(self, lost_s: float) -> None:
        """Count time in which no period was commanded as braked: the device was left standing where it is.

        Only the velocity falls, by what braking would have taken from it; there is no jump.

        Args:
            lost_s: How much later than it was due the present period begins [s].

        Raises:
            MotionError: The generator found no trajectory.
        """
        if self._ride is not None:
            self._ride.make_up(lost_s)
            self.velocity_rad_s = self._ride.velocity_rad_s.tolist()
            return
        order = self._plan_input
        order.current_position = self._input.current_position
        order.current_velocity = self._input.current_velocity
        order.current_acceleration = self._input.current_acceleration
        self._brake(order)
        plan(self._planner.calculate, order, self._plan)
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
        """Whether the device rests at the target of the last ``follow``."""
        near = all(abs(a - b) <= _REACHED_RAD for a, b in zip(self.position_rad, self._target, strict=True))
        return near and not self.moving

    def fastest_allowed_rad_s(self, speed: float) -> float:
        """The highest speed of any joint at a share of its limit [rad/s]."""
        return max(self._velocity_limits, default=0.0) * speed

    def braking_time_s(self) -> float:
        """How long ``brake`` would take from the present velocity [s], rounded up by the ramps at both ends."""
        return self.fastest_rad_s / self._braking + 3 * _BRAKING_RAMP_S
