"""Jerk-limited motion of all joints of one device, one control period at a time (``ruckig``)."""

from collections.abc import Sequence

from ruckig import ControlInterface, InputParameter, OutputParameter, Result, Ruckig, Synchronization

from device_agent.protocol.robot_type import RobotType

_BRAKING_RAMP_S = 0.01
"""Time in which braking reaches its full deceleration: short against the 50 ms in which a hold must be complete."""
_REST_RAD_S = 1e-6
_REACHED_RAD = 1e-4


class MotionError(Exception):
    """The trajectory generator refused its input; the device must hold."""


class Motion:
    """The commanded position and velocity of each joint, moved towards a target or to rest.

    Args:
        robot_type: Limits of each joint and the braking deceleration.
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
        self.brake()

    def follow(self, target_rad: Sequence[float], *, speed: float = 1.0, together: bool = False) -> None:
        """Head for ``target_rad``, shape (n,) [rad], already inside the joints' ranges.

        Args:
            target_rad: Where to come to rest.
            speed: Share of each joint's velocity limit, 0…1.
            together: Whether all joints arrive at the same time (a move) or each as fast as it can (a slider).
        """
        self._target = list(target_rad)
        self._input.control_interface = ControlInterface.Position
        self._input.synchronization = Synchronization.Time if together else Synchronization.No
        self._input.max_velocity = [limit * speed for limit in self._velocity_limits]
        self._input.max_acceleration = self._acceleration_limits
        self._input.max_jerk = self._jerk_limits
        self._input.target_position = self._target
        self._input.target_velocity = self._zeros
        self._input.target_acceleration = self._zeros

    def brake(self) -> None:
        """Come to rest as fast as the robot type allows, and stay there."""
        count = len(self._zeros)
        self._input.control_interface = ControlInterface.Velocity
        self._input.synchronization = Synchronization.No
        self._input.max_velocity = self._velocity_limits
        self._input.max_acceleration = [self._braking] * count
        self._input.max_jerk = [self._braking / _BRAKING_RAMP_S] * count
        self._input.target_velocity = self._zeros
        self._input.target_acceleration = self._zeros

    def update(self) -> list[float]:
        """Advance one period.

        Returns:
            The position to command now, shape (n,) [rad].

        Raises:
            MotionError: The generator found no trajectory; position and velocity are as they were.
        """
        result = self._generator.update(self._input, self._output)
        if result not in (Result.Working, Result.Finished):
            raise MotionError(f"no trajectory from here ({result})")
        self._output.pass_to_input(self._input)
        self.position_rad = list(self._output.new_position)
        self.velocity_rad_s = list(self._output.new_velocity)
        return self.position_rad

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

    def braking_time_s(self) -> float:
        """How long ``brake`` would take from the present velocity [s], rounded up by the ramps at both ends."""
        return self.fastest_rad_s / self._braking + 3 * _BRAKING_RAMP_S
