"""Acceleration-limited motion of a mobile base, one control period at a time."""

from ruckig import ControlInterface, InputParameter, OutputParameter, Ruckig, Synchronization

from device_agent.ports.driver import REST, Twist
from device_agent.protocol.manifests.robot_type import Base
from device_agent.runtime.control.joint_motion import generate

_RAMP_S = 0.1
"""Time in which the acceleration reaches its limit [s]."""
_BRAKING_RAMP_S = 0.01
_REST = 1e-6
_SAME = 1e-3


def limits_of(base: Base) -> Twist:
    """The highest twist of a base."""
    return Twist(base.max_linear_m_s, base.max_linear_m_s * base.sideways, base.max_angular_rad_s)


class BaseMotion:
    """The commanded twist of a base."""

    def __init__(self, base: Base, period_s: float) -> None:
        linear, angular = base.max_linear_acceleration_m_s2, base.max_angular_acceleration_rad_s2
        braking, turning = base.braking_linear_m_s2, base.braking_angular_rad_s2
        self.limits = limits_of(base)
        self._acceleration = [linear, linear, angular]
        self._braking = [braking, braking, turning]
        self._period_s = period_s
        self._generator = Ruckig(3, period_s)
        self._output = OutputParameter(3)
        self._input = InputParameter(3)
        self._input.control_interface = ControlInterface.Velocity
        self._input.synchronization = Synchronization.No
        self.twist = REST
        self.start()

    def start(self) -> None:
        """Start at rest."""
        self.twist = REST
        self._input.current_velocity = list(REST)
        self._input.current_acceleration = list(REST)
        self.brake()

    def follow(self, twist: Twist) -> None:
        """Accelerate to a twist that is inside the limits.

        A base that brakes harder than its acceleration limit continues to brake. Otherwise it would overshoot into
        reverse; see ``JointMotion.follow``.
        """
        current = self._input.current_acceleration
        if any(abs(part) > limit + _SAME for part, limit in zip(current, self._acceleration, strict=True)):
            return
        self._set_target(twist, self._acceleration, _RAMP_S)

    def brake(self) -> None:
        """Brake to rest at the robot type's deceleration."""
        self._set_target(REST, self._braking, _BRAKING_RAMP_S)

    def update(self, elapsed_s: float | None = None) -> Twist:
        """Advance one period, or ``elapsed_s`` of it [s].

        Raises:
            MotionError: The generator found no trajectory; the twist is unchanged.
        """
        self._generator.delta_time = elapsed_s or self._period_s
        generate(self._generator.update, self._input, self._output)
        self._output.pass_to_input(self._input)
        self.twist = Twist(*self._output.new_velocity)
        return self.twist

    @property
    def moving(self) -> bool:
        """Whether the commanded twist is not zero."""
        return any(abs(part) > _REST for part in self.twist)

    def braking_time_s(self) -> float:
        """Braking time from the present twist [s], including the ramps at both ends."""
        times = [abs(part) / limit for part, limit in zip(self.twist, self._braking, strict=True)]
        return max(times) + 3 * _BRAKING_RAMP_S if self.moving else 0.0

    def limits_to_stop_within(self, time_s: float) -> Twist:
        """The highest twist from which the base stops in ``time_s`` [s] if braking starts one period late."""
        braking_s = time_s - self._period_s - 2 * _BRAKING_RAMP_S
        return Twist(*(min(limit, rate * braking_s) for limit, rate in zip(self.limits, self._braking, strict=True)))

    def _set_target(self, twist: Twist, acceleration: list[float], ramp_s: float) -> None:
        self._input.target_velocity = list(twist)
        self._input.target_acceleration = list(REST)
        self._input.max_velocity = [max(limit, _REST) for limit in self.limits]
        self._input.max_acceleration = acceleration
        self._input.max_jerk = [value / ramp_s for value in acceleration]
