"""Joint commands: short trajectories that end at rest, because controllers of ROS have no watchdog.

A trajectory controller follows each new trajectory from its present motion to the commanded position, where it arrives
at rest after the horizon. While commands follow each other, it never arrives and so moves smoothly. When they end, the
arm is at rest after one horizon.
"""

import itertools
import secrets
from collections.abc import Sequence
from typing import NamedTuple

from device_agent.drivers.ros.joint_states import Measurement
from device_agent.drivers.ros.messages import Dialect, Message
from device_agent.drivers.ros.options import Command
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
    "goal": "control_msgs/FollowJointTrajectoryActionGoal",
}


class Publication(NamedTuple):
    """A message for a topic."""

    topic: str
    message: Message


class JointCommands:
    """Limits the speed of commands, and writes them as messages.

    After a pause of one horizon the robot rests. Then commands start at the measured position, with a ramp.

    Args:
        robot_type: Limits of the joints.
        names: ROS names of the joints, in the order of the robot type.
        command: Where commands are published.
        dialect: Version of ROS.
    """

    def __init__(self, robot_type: RobotType, names: Sequence[str], command: Command, dialect: Dialect) -> None:
        self._joints = robot_type.joints
        self._speeds = [_MARGIN * joint.max_velocity_rad_s for joint in robot_type.joints]
        self._braking_rad_s2 = robot_type.braking_rad_s2
        self._names = tuple(names)
        self._command = command
        self._dialect = dialect
        self._order = [self._names.index(name) for name in command.joints]
        self._horizon_s = command.horizon_ms / 1000
        self._interval_s = max(robot_type.period_ms / 1000, 1 / command.rate_hz)
        self._position: tuple[float, ...] = ()
        self._sent_s = self._since_s = -1e9
        self._session = secrets.token_hex(4)
        self._numbers = itertools.count(1)
        self.topic = f"{command.topic.rstrip('/')}/goal" if command.kind == "goal" else command.topic
        self.type = dialect.type(_TYPES[command.kind])

    def towards(self, target_rad: Sequence[float], measured: Measurement, now_s: float) -> Publication | None:
        """The command for a target within the limits, not far from the measured position.

        ``None`` if the previous one was just sent, or if measurements are overdue. Commands would then queue in the
        network, and the robot would make up for them at once.
        """
        elapsed_s = now_s - self._sent_s
        if elapsed_s < _EARLY * self._interval_s or now_s > measured.fresh_until_s:
            return None
        if elapsed_s > self._horizon_s:
            self._position, self._since_s, elapsed_s = measured.position_rad, now_s, self._interval_s
        elapsed_s = min(elapsed_s, _LATE * self._interval_s)
        running_s = now_s - self._since_s + self._interval_s
        # The robot follows by less than this time, so only one that does not follow, or does not report, is affected.
        lead_s = self._horizon_s + (measured.fresh_until_s - measured.at_s) / 2
        self._position = tuple(
            min(max(position + min(max(target - position, -step), step), at - lead_s * speed), at + lead_s * speed)
            for position, target, step, at, speed in zip(
                self._position,
                target_rad,
                self._steps(running_s, elapsed_s),
                measured.position_rad,
                self._speeds,
                strict=True,
            )
        )
        self._sent_s = now_s
        return self._publication(self._position, self._horizon_s)

    def hold(self, measured: Measurement) -> Publication:
        """The command that brakes to rest with the deceleration of the robot type, in one horizon or longer."""
        fastest = max((abs(value) for value in measured.velocity_rad_s), default=0.0)
        duration_s = max(self._horizon_s, fastest / self._braking_rad_s2)
        stops = [
            min(max(position + velocity * duration_s / 2, joint.lower_rad), joint.upper_rad)
            for position, velocity, joint in zip(
                measured.position_rad, measured.velocity_rad_s, self._joints, strict=True
            )
        ]
        return self._publication(stops, duration_s)

    def _steps(self, running_s: float, elapsed_s: float) -> list[float]:
        """Largest changes of the commanded positions [rad]."""
        return [
            min(speed, _RAMP * joint.max_acceleration_rad_s2 * running_s) * elapsed_s
            for joint, speed in zip(self._joints, self._speeds, strict=True)
        ]

    def _publication(self, position_rad: Sequence[float], duration_s: float) -> Publication:
        kind = self._command.kind
        if kind == "positions":
            data = [position_rad[index] for index in self._order]
            return Publication(self.topic, {"layout": {"dim": [], "data_offset": 0}, "data": data})
        if kind == "joint_state":
            # Without a header, rosbridge inserts the time of its own clock.
            values: Message = {"name": list(self._names), "position": list(position_rad), "velocity": [], "effort": []}
            return Publication(self.topic, values)
        trajectory = self._dialect.trajectory(self._names, position_rad, duration_s)
        if kind == "trajectory":
            return Publication(self.topic, trajectory)
        number = f"telescope-{self._session}-{next(self._numbers)}"
        return Publication(self.topic, self._dialect.goal(trajectory, number))
