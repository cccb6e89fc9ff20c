"""Joint commands: short trajectories that end at rest, because controllers of ROS have no watchdog.

A trajectory controller follows each new trajectory from its present motion to the commanded position, where it arrives
at rest after the horizon. While commands follow each other, it never arrives and so moves smoothly. When they end, the
arm is at rest after one horizon.
"""

from collections.abc import Mapping, Sequence

from device_agent.drivers.ros.goals import OVERDUE_S, Goals
from device_agent.drivers.ros.joint_states import Measurement
from device_agent.drivers.ros.options import Command
from device_agent.middleware.ros.connection import Command as Request
from device_agent.middleware.ros.connection import Publication
from device_agent.middleware.ros.messages import Dialect, Message
from device_agent.protocol.manifests.robot_type import RobotType

_RAMP = 2.0
"""Acceleration after rest as a multiple of the agent's limit, so that the agent's setpoints are not delayed."""
_MARGIN = 1.1
"""Highest speed of the commands as a multiple of the agent's limit, so that they catch up with a late period."""
_EARLY = 0.75
"""A command may be sent after this share of the interval, because periods are not exact."""
_LATE = 2.0
"""Longest interval for which one command makes up, in intervals. The robot brakes meanwhile, and starts again."""
_TYPES = {
    "trajectory": "trajectory_msgs/JointTrajectory",
    "positions": "std_msgs/Float64MultiArray",
    "joint_state": "sensor_msgs/JointState",
}


class JointCommands:
    """Limits the speed of one controller's commands, and writes them as messages.

    After a pause of one horizon the robot rests. Then commands start at the measured position, with a ramp.

    Args:
        robot_type: Limits of the joints.
        names: ROS names of the joints, in the order of the robot type.
        command: The controller.
        dialect: Version of ROS.

    Attributes:
        goals: Goals of the action; ``None`` for controllers with a topic.
    """

    def __init__(self, robot_type: RobotType, names: Sequence[str], command: Command, dialect: Dialect) -> None:
        self._order = [names.index(name) for name in command.joints or names]
        self._names = [names[index] for index in self._order]
        self._joints = [robot_type.joints[index] for index in self._order]
        self._speeds = [_MARGIN * joint.max_velocity_rad_s for joint in self._joints]
        self._braking_rad_s2 = robot_type.braking_rad_s2
        self._command = command
        self._dialect = dialect
        self._horizon_s = command.horizon_ms / 1000
        self._interval_s = max(robot_type.period_ms / 1000, 1 / command.rate_hz)
        self._position: tuple[float, ...] = ()
        self._completed: tuple[float, ...] = ()
        self._sent_s = self._since_s = -1e9
        self.goals = Goals(command.topic, dialect) if command.kind == "goal" else None

    @property
    def advertised(self) -> Mapping[str, str]:
        """Topics to publish, with their types."""
        if self.goals is not None:
            return self.goals.advertised
        return {self._command.topic: self._dialect.type(_TYPES[self._command.kind])}

    def towards(self, target_rad: Sequence[float], measured: Measurement, now_s: float) -> Request | None:
        """The command for a target within the limits, not far from the measured position.

        ``None`` if nothing has to be sent now, or if measurements are overdue. Commands would then queue in the
        network, and the robot would make up for them at once.

        Args:
            target_rad: Positions of all joints of the robot type [rad].
            measured: Their measurement.
            now_s: The monotonic clock [s].
        """
        elapsed_s = now_s - self._sent_s
        if elapsed_s < _EARLY * self._interval_s or now_s > measured.fresh_until_s:
            return None
        target = self._own(target_rad)
        if self.goals is not None and target == self._completed:
            return None  # another goal would replace this one, whose result would never arrive
        if elapsed_s > self._horizon_s:
            self._position, self._since_s, elapsed_s = self._own(measured.position_rad), now_s, self._interval_s
        elapsed_s = min(elapsed_s, _LATE * self._interval_s)
        running_s = now_s - self._since_s + self._interval_s
        # The robot follows by less than this time, so only one that does not follow, or does not report, is affected.
        lead_s = self._horizon_s + (measured.fresh_until_s - measured.at_s) / 2
        self._position = tuple(
            min(max(position + min(max(aim - position, -step), step), at - lead_s * speed), at + lead_s * speed)
            for position, aim, step, at, speed in zip(
                self._position,
                target,
                self._steps(running_s, elapsed_s),
                self._own(measured.position_rad),
                self._speeds,
                strict=True,
            )
        )
        self._sent_s = now_s
        self._completed = target if self._position == target else ()
        return self._request(self._position, self._horizon_s, due_s=now_s + self._horizon_s + OVERDUE_S)

    def hold(self, measured: Measurement) -> Request:
        """The command that brakes to rest with the deceleration of the robot type, in one horizon or longer."""
        positions, velocities = self._own(measured.position_rad), self._own(measured.velocity_rad_s)
        duration_s = max(self._horizon_s, max(map(abs, velocities), default=0.0) / self._braking_rad_s2)
        stops = [
            min(max(position + velocity * duration_s / 2, joint.lower_rad), joint.upper_rad)
            for position, velocity, joint in zip(positions, velocities, self._joints, strict=True)
        ]
        self._completed = ()
        return self._request(stops, duration_s, due_s=None)

    def _own(self, values: Sequence[float]) -> tuple[float, ...]:
        """Values of the controller's joints, in its order."""
        return tuple(values[index] for index in self._order)

    def _steps(self, running_s: float, elapsed_s: float) -> list[float]:
        """Largest changes of the commanded positions [rad]."""
        return [
            min(speed, _RAMP * joint.max_acceleration_rad_s2 * running_s) * elapsed_s
            for joint, speed in zip(self._joints, self._speeds, strict=True)
        ]

    def _request(self, position_rad: Sequence[float], duration_s: float, *, due_s: float | None) -> Request:
        topic, kind = self._command.topic, self._command.kind
        if kind == "positions":
            return Publication(topic, {"layout": {"dim": [], "data_offset": 0}, "data": list(position_rad)})
        if kind == "joint_state":
            # Without a header, rosbridge inserts the time of its own clock.
            values: Message = {"name": self._names, "position": list(position_rad), "velocity": [], "effort": []}
            return Publication(topic, values)
        trajectory = self._dialect.trajectory(self._names, position_rad, duration_s)
        return Publication(topic, trajectory) if self.goals is None else self.goals.start(trajectory, due_s=due_s)
