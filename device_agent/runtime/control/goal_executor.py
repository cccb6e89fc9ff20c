"""What an action asks of one device's joints and base: one course at a time, carried out tick by tick."""

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

_LONGEST_DRIVE_S = 60.0
_SAME_RAD = 1e-4


class GoalExecutor:
    """Joints and base of one device, and the course that they are on. Not thread-safe: its owner locks.

    Args:
        robot_type: Joints and limits.
        envelope: What positions may be.

    Attributes:
        motion: The joints'.
        base: The base's, if there is one.
        course: What an action has asked, until it has ended.
    """

    def __init__(self, robot_type: RobotType, envelope: MotionLimits) -> None:
        self._period_s = robot_type.period_ms / 1000
        self._envelope = envelope
        self.motion = JointMotion(robot_type)
        self.base = None if robot_type.base is None else BaseMotion(robot_type.base, self._period_s)
        self.course: MotionGoal | None = None
        self._arrival = GoalTolerance([joint.name for joint in robot_type.joints], self._period_s)

    # ------------------------------------------------------------ what actions ask

    def move(self, position_rad: Mapping[str, float], speed: float) -> JointGoal:
        """See ``Controller.move``.

        Raises:
            Refused: Unknown joint, a number that is none, outside a joint's range, or no room there.
        """
        if not 0 < speed <= 1:
            raise Refused("bad_speed", f"speed must be above 0 and at most 1, not {speed}")
        target = self._envelope.target(position_rad, self.motion.position_rad)
        self._replace()
        self._arrival.begin(_differ(target, self.motion.position_rad))
        self.course = move = JointGoal(target_rad=target, speed=speed)
        return move

    def go_along(self, way: Trajectory) -> TrajectoryGoal:
        """See ``Controller.go_along``.

        Raises:
            Refused: It begins elsewhere, or leaves a joint's range.
        """
        far_rad = float(np.max(np.abs(way.position_rad[0] - self.motion.position_rad), initial=0.0))
        if self.motion.moving or not far_rad <= _SAME_RAD:
            raise Refused("moved", "the robot is no longer where the way begins; plan it again")
        self._envelope.check_way(way.position_rad)
        self._replace()
        self._arrival.begin(np.flatnonzero(np.any(way.position_rad != way.position_rad[0], axis=0)).tolist())
        self.course = passage = TrajectoryGoal(way=way)
        return passage

    def drive(self, twist: Twist, duration_s: float) -> DriveGoal:
        """See ``Controller.drive``.

        Raises:
            Refused: No base, a number that is none, or beyond the base's limits.
        """
        if self.base is None:
            raise Refused("no_base", "this robot does not drive")
        if not 0 < duration_s <= _LONGEST_DRIVE_S:
            raise Refused(
                "bad_duration", f"a drive lasts more than 0 and at most {_LONGEST_DRIVE_S:.0f} s, not {duration_s}"
            )
        for asked, limit, name in zip(twist, self.base.limits, Twist._fields, strict=True):
            if not abs(asked) <= limit:
                raise Refused("out_of_range", f"{name} can be up to {limit:.3f}, not {asked}")
        self._replace()
        self.course = drive = DriveGoal(twist=twist, periods=math.ceil(duration_s / self._period_s))
        return drive

    # ------------------------------------------------------------ tick by tick

    def follow(self, allowed: float) -> None:
        """Set in motion what the course asks.

        Args:
            allowed: Share of the speed that the room leaves, above 0.
        """
        match self.course:
            case JointGoal(target_rad=target, speed=speed):
                self.motion.follow(target, speed=speed * allowed, together=True)
            case TrajectoryGoal(way=way):
                self.motion.ride(way, share=allowed)
            case DriveGoal() as drive if self.base is not None:
                if drive.periods > 0:
                    self.base.follow(Twist(*(part * allowed for part in drive.twist)))
                else:
                    self.base.brake()
                drive.periods -= 1
            case _:
                self.brake()  # what setpoints have begun does not go on beside an action

    def look(self, late_s: float) -> Clearance | None:
        """What is in the way of the period that comes, if anything is.

        Args:
            late_s: How much later than it was due the present period begins [s].

        Raises:
            MotionError: No way to go on.
        """
        if self.motion.braking:
            if self.motion.moving and late_s > self._period_s / 2:
                self.motion.make_up(late_s)  # a busy machine must not stretch a hold
            return None
        return self._envelope.blocked(self.motion.propose())

    def update(self, passed_s: float | None = None) -> None:
        """Advance one period, or by what has passed of one [s].

        Raises:
            MotionError: No way to go on.
        """
        self.motion.update(passed_s)
        if self.base is not None:
            self.base.update(passed_s)

    def settle(self, limited: tuple[str, ...], *, measured_rad: Sequence[float] | None, soft: Collection[int]) -> None:
        """See whether the course has come to its end.

        Args:
            limited: What makes it other than asked now.
            measured_rad: Where the joints are, shape (n,); where nobody measures, where they are told to be.
            soft: Joints that hold with less than all their strength.
        """
        course = self.course
        if course is None:
            return
        course.note(limited)
        try:
            done = self._drove(course) if isinstance(course, DriveGoal) else self._arrived(measured_rad, soft)
        except Refused as short:
            self.interrupt(short)
            return
        if done:
            self.course = None
            course.end(GoalResult.REACHED)

    def _drove(self, drive: DriveGoal) -> bool:
        return drive.periods <= 0 and not self.moving

    def _arrived(self, measured_rad: Sequence[float] | None, soft: Collection[int]) -> bool:
        """Whether the joints rest at their target.

        Raises:
            Refused: They were told to long ago.
        """
        if not self.motion.reached:
            return False
        return measured_rad is None or self._arrival.there(self.motion.position_rad, measured_rad, soft=soft)

    def interrupt(self, why: Refused) -> None:
        """End the course, if there is one, and brake."""
        if self.course is not None:
            interrupted, self.course = self.course, None
            interrupted.end(GoalResult.INTERRUPTED, why)
            self.brake()

    def start_at(self, position_rad: Sequence[float]) -> None:
        """Begin at rest at ``position_rad``, shape (n,) [rad]."""
        self.motion.start_at(position_rad)
        if self.base is not None:
            self.base.start()

    def brake(self) -> None:
        """Come to rest as fast as the robot type allows."""
        self.motion.brake()
        if self.base is not None:
            self.base.brake()

    def give_up(self) -> None:
        """Brake; where even that cannot be planned, stand still at once."""
        self.brake()
        try:
            self.motion.update()
        except MotionError:
            self.motion.start_at(self.motion.position_rad)

    @property
    def moving(self) -> bool:
        """Whether any commanded velocity is not zero."""
        return self.motion.moving or (self.base is not None and self.base.moving)

    def faster_than(self, creep_rad_s: float) -> bool:
        """Whether it is more than creeping at its target [rad/s]; a base that moves at all is."""
        return self.motion.fastest_rad_s > creep_rad_s or (self.base is not None and self.base.moving)

    def braking_time_s(self) -> float:
        """How long ``brake`` would take [s]."""
        return max(self.motion.braking_time_s(), 0.0 if self.base is None else self.base.braking_time_s())

    @property
    def twist(self) -> Twist:
        """The base's commanded twist."""
        return REST if self.base is None else self.base.twist

    def _replace(self) -> None:
        self.interrupt(Refused("replaced", "another course took its place"))


def _differ(one: Sequence[float], other: Sequence[float]) -> list[int]:
    """Indices of the joints that are not in the same place in both."""
    return [index for index, (a, b) in enumerate(zip(one, other, strict=True)) if abs(a - b) > _SAME_RAD]
