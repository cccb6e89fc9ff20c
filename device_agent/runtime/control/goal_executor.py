"""Executes one motion goal at a time on the joints and the base of a device."""

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from device_agent.ports.driver import REST, Twist
from device_agent.ports.geometry import Clearance
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.base_motion import BaseMotion
from device_agent.runtime.control.goal_tolerance import GoalTolerance
from device_agent.runtime.control.goals import DriveGoal, GoalResult, JointGoal, MotionGoal, TrajectoryGoal
from device_agent.runtime.control.joint_motion import JointMotion, MotionError
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.trajectory import Trajectory

_MAX_DRIVE_S = 60.0
_SAME_RAD = 1e-4


class GoalExecutor:
    """Joints and base of one device, and their current goal. Not thread-safe: the controller locks.

    Attributes:
        motion: Motion of the joints.
        base: Motion of the base, if there is one.
        goal: Goal of the running action until it ends.
    """

    def __init__(self, robot_type: RobotType, limits: MotionLimits) -> None:
        self._period_s = robot_type.period_ms / 1000
        self._limits = limits
        self.motion = JointMotion(robot_type)
        self.base = None if robot_type.base is None else BaseMotion(robot_type.base, self._period_s)
        self.goal: MotionGoal | None = None
        self._tolerance = GoalTolerance([joint.name for joint in robot_type.joints], self._period_s)

    # ------------------------------------------------------------ goals

    def start_joint_goal(self, position_rad: Mapping[str, float], speed: float) -> JointGoal:
        """See ``Controller.start_joint_goal``."""
        if not 0 < speed <= 1:
            raise Refused("bad_speed", f"speed must be above 0 and at most 1, not {speed}")
        target = self._limits.resolve_target(position_rad, self.motion.position_rad)
        self._interrupt_previous()
        pairs = zip(target, self.motion.position_rad, strict=True)
        self._tolerance.start([index for index, (a, b) in enumerate(pairs) if abs(a - b) > _SAME_RAD])
        self.goal = goal = JointGoal(target_rad=target, speed=speed)
        return goal

    def start_trajectory(self, trajectory: Trajectory) -> TrajectoryGoal:
        """See ``Controller.start_trajectory``."""
        start_rad = trajectory.position_rad[0]
        distance_rad = float(np.max(np.abs(start_rad - self.motion.position_rad), initial=0.0))
        if self.motion.moving or not distance_rad <= _SAME_RAD:
            raise Refused("moved", "the robot is no longer at the start of the trajectory; plan it again")
        self._limits.check_trajectory(trajectory.position_rad)
        self._interrupt_previous()
        self._tolerance.start(np.flatnonzero(np.any(trajectory.position_rad != start_rad, axis=0)).tolist())
        self.goal = goal = TrajectoryGoal(trajectory=trajectory)
        return goal

    def start_drive(self, twist: Twist, duration_s: float) -> DriveGoal:
        """See ``Controller.start_drive``."""
        if self.base is None:
            raise Refused("no_base", "this robot does not drive")
        if not 0 < duration_s <= _MAX_DRIVE_S:
            raise Refused(
                "bad_duration", f"a drive lasts more than 0 and at most {_MAX_DRIVE_S:.0f} s, not {duration_s}"
            )
        for requested, limit, name in zip(twist, self.base.limits, Twist._fields, strict=True):
            if not abs(requested) <= limit:
                raise Refused("out_of_range", f"{name} can be up to {limit:.3f}, not {requested}")
        self._interrupt_previous()
        self.goal = goal = DriveGoal(twist=twist, periods=math.ceil(duration_s / self._period_s))
        return goal

    # ------------------------------------------------------------ each period

    def advance(self, allowed: float) -> None:
        """Set this period's motion towards the goal.

        Args:
            allowed: Share of the speed that the room allows, above 0.
        """
        match self.goal:
            case JointGoal(target_rad=target, speed=speed):
                self.motion.follow(target, speed=speed * allowed, together=True)
            case TrajectoryGoal(trajectory=trajectory):
                self.motion.follow_trajectory(trajectory, share=allowed)
            case DriveGoal() as drive if self.base is not None:
                if drive.periods > 0:
                    self.base.follow(Twist(*(part * allowed for part in drive.twist)))
                else:
                    self.base.brake()
                drive.periods -= 1
            case _:
                self.brake()  # motion that setpoints started does not continue during an action

    def check_clearance(self, late_s: float) -> Clearance | None:
        """The obstacle on the path of the next period and of the braking after it; ``late_s``: its delay [s]."""
        if self.motion.braking:
            if self.motion.moving and late_s > self._period_s / 2:
                self.motion.catch_up(late_s)  # a busy machine must not lengthen a hold
            return None
        return self._limits.find_obstacle(self.motion.propose())

    def update(self, elapsed_s: float | None = None) -> None:
        """Advance one period, or ``elapsed_s`` of it [s]."""
        self.motion.update(elapsed_s)
        if self.base is not None:
            self.base.update(elapsed_s)

    def finish(
        self, limited: tuple[str, ...], *, measured_rad: Sequence[float] | None, soft: Collection[int], settled: bool
    ) -> None:
        """End the goal if it has been reached.

        Args:
            limited: Limits that apply in this period.
            measured_rad: Measured positions, shape (n,); ``None``: trust the commanded ones.
            soft: Joints with reduced stiffness.
            settled: Whether the device has reported the end of the previous command.
        """
        goal = self.goal
        if goal is None:
            return
        goal.add_limits(limited)
        try:
            done = (
                goal.periods <= 0 and not self.moving
                if isinstance(goal, DriveGoal)
                else self._is_reached(measured_rad, soft) and settled
            )
        except Refused as refused:
            self.interrupt(refused)
            return
        if done:
            self.goal = None
            goal.end(GoalResult.REACHED)

    def _is_reached(self, measured_rad: Sequence[float] | None, soft: Collection[int]) -> bool:
        if not self.motion.reached:
            return False
        return measured_rad is None or self._tolerance.is_reached(self.motion.position_rad, measured_rad, soft=soft)

    def interrupt(self, why: Refused) -> None:
        """End the goal, if there is one, and brake."""
        if self.goal is not None:
            interrupted, self.goal = self.goal, None
            interrupted.end(GoalResult.INTERRUPTED, why)
            self.brake()

    def start_at(self, position_rad: Sequence[float]) -> None:
        """Start at rest at ``position_rad``, shape (n,) [rad]."""
        self.motion.start_at(position_rad)
        if self.base is not None:
            self.base.start()

    def brake(self) -> None:
        """Brake to rest at the robot type's deceleration."""
        self.motion.brake()
        if self.base is not None:
            self.base.brake()

    def abort(self) -> None:
        """Brake; if no braking trajectory is found, stop immediately."""
        self.brake()
        try:
            self.motion.update()
        except MotionError:
            self.motion.start_at(self.motion.position_rad)

    @property
    def moving(self) -> bool:
        """Whether any commanded velocity is not zero."""
        return self.motion.moving or (self.base is not None and self.base.moving)

    def faster_than(self, speed_rad_s: float) -> bool:
        """Whether a joint is faster than this [rad/s], or the base moves."""
        return self.motion.fastest_rad_s > speed_rad_s or (self.base is not None and self.base.moving)

    def braking_time_s(self) -> float:
        """Duration of ``brake`` [s]."""
        return max(self.motion.braking_time_s(), 0.0 if self.base is None else self.base.braking_time_s())

    @property
    def requested_rad(self) -> Sequence[float]:
        """Final positions of the goal, shape (n,) [rad]; empty if it has none."""
        match self.goal:
            case JointGoal(target_rad=target):
                return tuple(target)
            case TrajectoryGoal(trajectory=trajectory):
                return tuple(trajectory.position_rad[-1].tolist())
        return ()

    @property
    def twist(self) -> Twist:
        """Commanded twist of the base."""
        return REST if self.base is None else self.base.twist

    def _interrupt_previous(self) -> None:
        self.interrupt(Refused("replaced", "another goal replaced it"))
