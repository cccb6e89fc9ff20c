"""Controllers of joints and of a base, as in ``ros_controllers``, in steps of the robot's time."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

CYCLE_S = 0.005
STOP_RAD_S2 = 25.0
_MAX_VELOCITY_RAD_S = 3.3
_MAX_ACCELERATION_RAD_S2 = 60.0
_SERVO_LAG_S = 0.04
_MOTOR_LAG_S = 0.01
CMD_VEL_TIMEOUT_S = 0.25
_BASE_M_S2 = 3.0


class RejectedError(Exception):
    """A controller does not accept a command."""


class _Segment(NamedTuple):
    """A cubic from one state to another."""

    start_s: float
    duration_s: float
    position: tuple[float, float]
    velocity: tuple[float, float]

    def at(self, time_s: float) -> tuple[float, float]:
        """Position and velocity; afterwards the end, at rest."""
        share = (time_s - self.start_s) / self.duration_s
        (p, q), (v, w) = self.position, self.velocity
        if share >= 1.0:
            return q, 0.0
        v, w = v * self.duration_s, w * self.duration_s
        c, d = 3 * (q - p) - 2 * v - w, 2 * (p - q) + v + w
        return p + share * (v + share * (c + share * d)), (v + share * (2 * c + share * 3 * d)) / self.duration_s


class JointController:
    """``joint_trajectory_controller``: follows the newest trajectory from its present motion, then holds.

    With ``target`` it is a ``position_controllers/JointGroupPositionController``: it follows the newest target.

    Attributes:
        position: True positions by name [rad]; ``velocity`` [rad/s].
        goal: Positions at the end of the newest trajectory [rad]; ``end_s``: when it ends, on the robot's clock [s].
    """

    def __init__(self, position_rad: Mapping[str, float]) -> None:
        self.names = tuple(position_rad)
        self.end_s = 0.0
        self.goal: dict[str, float] = {}
        self.position = dict(position_rad)
        self.velocity = dict.fromkeys(self.names, 0.0)
        self.time_s = 0.0
        self._desired = {name: (value, 0.0) for name, value in position_rad.items()}
        self._segments: dict[str, list[_Segment]] = {name: [] for name in self.names}
        self._targets: dict[str, float] = {}

    @property
    def at_rest(self) -> bool:
        """Whether no joint moves."""
        return all(abs(value) < 1e-3 for value in self.velocity.values())

    def follow(self, trajectory: Mapping[str, Any], joints: Sequence[str] = ()) -> None:
        """Replace the trajectory of all joints, or of those of one of several controllers.

        Raises:
            RejectedError: It is invalid.
        """
        names, points = trajectory["joint_names"], trajectory["points"]
        if sorted(names) != sorted(joints or self.names) or not points:
            raise RejectedError(f"joints {names} for the controller of {list(self.names)}")
        end_s = 0.0
        states = [(0.0, [self._desired[name] for name in names])]
        for point in points:
            time_s = duration_s(point["time_from_start"])
            values = [*point["positions"], *point["velocities"]]
            if len(values) != 2 * len(names) or not all(map(math.isfinite, values)) or time_s <= end_s:
                raise RejectedError("a point is invalid")
            end_s = time_s
            states.append((time_s, list(zip(point["positions"], point["velocities"], strict=True))))
        for index, name in enumerate(names):
            self._segments[name] = [
                _Segment(self.time_s + first_s, second_s - first_s, (p, q), (v, w))
                for (first_s, before), (second_s, after) in itertools.pairwise(states)
                for (p, v), (q, w) in [(before[index], after[index])]
            ]
        self._targets = {}
        self.goal, self.end_s = dict(zip(names, points[-1]["positions"], strict=True)), self.time_s + end_s

    def approach(self, names: Sequence[str], target_rad: Sequence[float]) -> None:
        """Follow a target as fast as the motors can.

        Raises:
            RejectedError: It is invalid.
        """
        if sorted(names) != sorted(self.names) or len(target_rad) != len(names):
            raise RejectedError(f"{len(target_rad)} targets for {len(self.names)} joints")
        self._targets = dict(zip(names, target_rad, strict=True))

    def stop(self) -> None:
        """Brake to rest."""
        self._targets = {}
        for name in self.names:
            position, velocity = self.position[name], self.velocity[name]
            braking_s = max(abs(velocity) / STOP_RAD_S2, CYCLE_S)
            end = position + velocity * braking_s / 2
            self._segments[name] = [_Segment(self.time_s, braking_s, (position, end), (velocity, 0.0))]

    def step(self) -> None:
        """One cycle."""
        self.time_s += CYCLE_S
        for name in self.names:
            before = self.position[name]
            if self._targets:
                self.position[name] += self._servo(name) * CYCLE_S
                self._desired[name] = (self.position[name], 0.0)
            else:
                while len(self._segments[name]) > 1 and self._segments[name][1].start_s <= self.time_s:
                    del self._segments[name][0]
                if self._segments[name]:
                    self._desired[name] = self._segments[name][0].at(self.time_s)
                self.position[name] += (self._desired[name][0] - before) * CYCLE_S / _MOTOR_LAG_S
            self.velocity[name] = (self.position[name] - before) / CYCLE_S

    def _servo(self, name: str) -> float:
        wanted = (self._targets[name] - self.position[name]) / _SERVO_LAG_S
        wanted = min(max(wanted, -_MAX_VELOCITY_RAD_S), _MAX_VELOCITY_RAD_S)
        change = _MAX_ACCELERATION_RAD_S2 * CYCLE_S
        return self.velocity[name] + min(max(wanted - self.velocity[name], -change), change)


class TrajectoryAction:
    """Action FollowJointTrajectory of ``joint_trajectory_controller``: a new goal replaces the previous one.

    Args:
        joints: The controller.

    Attributes:
        ended: Goals that have ended since the last look: goal, outcome, error code and text. An outcome is
            ``succeeded``, ``preempted``, ``aborted`` or ``rejected``.
        newest: The goal that was accepted last.
        enabled: Whether the controller runs. Otherwise it rejects goals.
        silent: Whether it reports no results.
        cancelled: Number of goals that were cancelled.
        succeeded: Number of goals that were completed.
    """

    def __init__(self, joints: JointController) -> None:
        self._joints = joints
        self._goal: Any = None
        self.newest: Any = None
        self.enabled = True
        self.silent = False
        self.cancelled = self.succeeded = 0
        self.ended: list[tuple[Any, str, int, str]] = []

    def start(self, goal: Any, trajectory: Mapping[str, Any]) -> bool:
        """Start a goal, unless it is invalid. Returns whether it was accepted."""
        if not self.enabled:
            self._end(goal, "rejected", -1, "the controller is not running")
            return False
        try:
            self._joints.follow(trajectory)
        except RejectedError as error:
            self._end(goal, "rejected", -1, str(error))
            return False
        if self._goal is not None:
            self._end(self._goal, "preempted", -1, "a new goal has arrived")
        self._goal = self.newest = goal
        return True

    def cancel(self, goal: Any) -> None:
        """Stop, if this is the present goal."""
        if goal is not None and goal == self._goal:
            self.cancelled += 1
            self._joints.stop()
            self._end(goal, "preempted", 0, "")

    def abort(self, code: int, text: str) -> None:
        """Stop, and end the present goal as failed."""
        self._joints.stop()
        if self._goal is not None:
            self._end(self._goal, "aborted", code, text)

    def step(self) -> None:
        """End the goal when the joints have arrived. Call it after each cycle of the joints."""
        joints = self._joints
        if self._goal is None or joints.time_s < joints.end_s or not joints.at_rest:
            return
        if all(abs(joints.position[name] - value) < 0.01 for name, value in joints.goal.items()):
            self.succeeded += 1
            self._end(self._goal, "succeeded", 0, "")

    def _end(self, goal: Any, outcome: str, code: int, text: str) -> None:
        if goal == self._goal:
            self._goal = None
        if not self.silent:
            self.ended.append((goal, outcome, code, text))


class BaseController:
    """``diff_drive_controller``: follows the newest velocity, and brakes after ``CMD_VEL_TIMEOUT_S`` without one."""

    def __init__(self) -> None:
        self.forward_m_s = self.turn_rad_s = 0.0
        self.x_m = self.y_m = self.yaw_rad = 0.0
        self._wanted = (0.0, 0.0)
        self._age_s = math.inf

    def drive(self, twist: Mapping[str, Any]) -> None:
        """Replace the commanded velocity."""
        self._wanted, self._age_s = (twist["linear"]["x"], twist["angular"]["z"]), 0.0

    def stop(self) -> None:
        """Brake to rest."""
        self._wanted = (0.0, 0.0)

    def step(self) -> None:
        """One cycle."""
        self._age_s += CYCLE_S
        if self._age_s > CMD_VEL_TIMEOUT_S:
            self.stop()
        change = _BASE_M_S2 * CYCLE_S
        self.forward_m_s += min(max(self._wanted[0] - self.forward_m_s, -change), change)
        self.turn_rad_s += min(max(self._wanted[1] - self.turn_rad_s, -5 * change), 5 * change)
        self.yaw_rad += self.turn_rad_s * CYCLE_S
        self.x_m += self.forward_m_s * math.cos(self.yaw_rad) * CYCLE_S
        self.y_m += self.forward_m_s * math.sin(self.yaw_rad) * CYCLE_S


def duration_s(value: Mapping[str, int]) -> float:
    """A duration of ROS 1 or ROS 2 [s]."""
    return float(value.get("secs", value.get("sec", 0)) + value.get("nsecs", value.get("nanosec", 0)) / 1e9)
