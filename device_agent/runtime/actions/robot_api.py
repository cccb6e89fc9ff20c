"""What a script's calls reach on its own device, for as long as its action has it."""

import threading
from collections.abc import Callable, Mapping
from typing import Any

from device_agent.ports.driver import REST, Twist
from device_agent.ports.geometry import GeometryError, RobotGeometry
from device_agent.ports.script_calls import AskLatest, AskState, Call, Home, Play
from device_agent.protocol import Drive, GoTo, LookAt, MoveJoints, MovePose
from device_agent.runtime.actions.device_context import SCRIPT_NAMES, DeviceContext, by_name, tag
from device_agent.runtime.actions.skill_runner import SkillRunner
from device_agent.runtime.authority.authority import Reservation
from device_agent.runtime.control.goals import GoalResult, MotionGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import gaze
from device_agent.runtime.planning.keyframe_trajectory import FASTEST, Timeline
from device_agent.runtime.planning.motion_planner import MotionPlanner, quaternion_of
from device_agent.runtime.planning.navigator import ODOMETRY, POSITIONS, UPDATE_PERIOD_S, Navigator, PoseEstimator
from device_agent.runtime.readings import Reading


class RobotApi:
    """``Reach`` of one action.

    Args:
        body: The device.

    Attributes:
        limited: What limited its motion so far, as telemetry names it.
        performer: Does what it shows.
        tenure: Its right to the device.
        over: Set once the action is over, or has lost the device.
    """

    def __init__(self, body: DeviceContext) -> None:
        self._body = body
        self.tenure = Reservation(epoch=-1, on_lost=_nobody)  # of nothing, until ``begin``
        self.over = threading.Event()
        self.joints = tuple(joint.name for joint in body.robot_type.joints)
        self.frames = () if body.geometry is None else tuple(body.geometry.frames)
        self.can = body.script_calls()
        self._supported = body.supported()
        self.limited: tuple[str, ...] = ()
        self.performer = SkillRunner(body, self)

    def begin(self, epoch: int, on_lost: Callable[[Refused], None]) -> None:
        """Take the device. ``on_lost`` is called when somebody takes it away, with the controller locked.

        Raises:
            Refused: It cannot be taken.
        """
        self.tenure = self._body.controller.begin_action(epoch=epoch, on_lost=on_lost)

    def end(self) -> None:
        """The action is over, or has lost the device: no skill goes on. Never blocks."""
        self.over.set()

    def give_back(self) -> None:
        """Leave the device; what still moves is held."""
        self.end()
        self._body.controller.end_action(self.tenure)

    def do(self, call: Call) -> Any:
        """See ``Reach``."""
        self._check_supported(call)
        match call:
            case MoveJoints(position_rad=position_rad, speed=speed, plan=plan):
                self.move_joints(position_rad, speed, plan=plan)
            case Play():
                self._play(call)
            case Home(speed=speed):
                self.move_joints(self._body.robot_type.home_rad, speed)
            case MovePose():
                self._move_to(call)
            case Drive():
                self._drive(call)
            case GoTo():
                self._go_to(call)
            case LookAt():
                self._look(call)
            case AskState():
                return self._state()
            case AskLatest(device=device, stream=stream):
                return self._latest(device, stream)
            case _:
                self.performer.show(call)
        return None

    def _check_supported(self, call: Call) -> None:
        if type(call) not in self._supported:
            name = SCRIPT_NAMES.get(type(call), tag(type(call)))
            raise Refused("cannot", f"this robot has no {name}; it has {', '.join(self.can)}")

    def move_joints(self, position_rad: Mapping[str, float], speed: float, *, plan: bool = False) -> None:
        """Move and wait until there [rad], around what is in between if ``plan``.

        Raises:
            Refused: It did not get there.
        """
        controller = self._body.controller
        if plan:
            routes = MotionPlanner(self._body.robot_type, self._shape())
            goal_rad = controller.target(self.tenure, position_rad)
            way = routes.around(controller.commanded_rad, goal_rad, speed=speed, ended=self.over.is_set)
            self.follow(controller.go_along(self.tenure, way))
        else:
            self.follow(controller.move(self.tenure, dict(position_rad), speed=speed))

    def _play(self, call: Play) -> None:
        if not 0 < call.speed <= FASTEST:  # false for NaN
            raise Refused("bad_speed", f"speed must be above 0 and at most {FASTEST:g}, not {call.speed}")
        self.performer.come_to_rest()
        controller = self._body.controller
        timeline = Timeline(self._body.robot_type, controller.commanded_rad, call)
        for number, pose in enumerate(timeline.poses(), call.first):
            try:
                controller.target(self.tenure, pose)
            except Refused as refused:
                raise Refused(refused.code, f"keyframe {number}: {refused.message}") from refused
        passage = controller.go_along(self.tenure, timeline.way())
        passage.note(timeline.limited)
        self.follow(passage)

    def _move_to(self, call: MovePose) -> None:
        if call.straight and call.plan:
            raise Refused("bad_way", "a way is straight or planned, not both")
        controller, geometry = self._body.controller, self._shape()
        start = controller.commanded_rad
        frame = call.frame or geometry.frames[-1]
        w, x, y, z = quaternion_of(geometry.poses(start), frame, call.quaternion, call.rpy_rad)
        pose = (*call.position_m, w, x, y, z)
        if call.straight:
            way = MotionPlanner(self._body.robot_type, geometry).straight(start, frame, pose, speed=call.speed)
            self.follow(controller.go_along(self.tenure, way))
            return
        try:
            solved = geometry.solve(frame, pose, start)
        except GeometryError as error:
            raise Refused("out_of_reach", str(error)) from error
        self.move_joints(by_name(self._body.robot_type, solved), call.speed, plan=call.plan)

    def _drive(self, call: Drive) -> None:
        twist = Twist(call.forward_m_s, call.left_m_s, call.turn_rad_s)
        self.follow(self._body.controller.drive(self.tenure, twist, duration_s=call.duration_s))

    def _go_to(self, call: GoTo) -> None:
        """A short drive after the other, each of which ends by itself: who stops deciding stands."""
        body, controller = self._body, self._body.controller
        errand, where = Navigator.of(call.x_m, call.y_m, call.yaw_rad, body.robot_type), PoseEstimator(body.name)
        waited_s = 0.0
        while not self.over.is_set():
            ground = None if body.ground is None else body.ground()
            if ground is None:
                raise Refused("no_ground", "nobody sees what stands in the room now; drive by hand")
            place = where.place(body.reported().get(ODOMETRY), body.room.newest(POSITIONS, f"x_m.{body.name}"))
            try:
                twist, waited_s = errand.twist(place, ground), 0.0
            except Refused as refused:
                waited_s += UPDATE_PERIOD_S
                if waited_s > errand.patience_s(refused):
                    raise
                twist = REST
            if twist is None:
                break
            drive = controller.drive(self.tenure, twist, duration_s=3 * UPDATE_PERIOD_S)
            if drive.finished.wait(UPDATE_PERIOD_S):
                self.follow(drive)
        self.follow(controller.drive(self.tenure, REST, duration_s=UPDATE_PERIOD_S))

    def follow(self, course: MotionGoal) -> None:
        """Have it begin, and wait for its end."""
        self._body.hurry()
        course.finished.wait()
        self.limited += tuple(one for one in course.limited if one not in self.limited)
        if course.outcome is not GoalResult.REACHED:
            raise course.why or Refused("interrupted", "the move was interrupted")

    def _look(self, call: LookAt) -> None:
        if self._body.robot_type.gaze is None:
            self.performer.perform(call)
        else:
            start = self._body.seen().position_rad
            self.move_joints(gaze.aim(self._body.robot_type, self._shape(), start, call.position_m), call.speed)

    def _shape(self) -> RobotGeometry:
        if self._body.geometry is None:
            raise Refused("no_model", "this robot's type has no model")
        return self._body.geometry

    def _state(self) -> dict[str, Any]:
        seen, kind = self._body.seen(), self._body.robot_type
        return {
            "position_rad": by_name(kind, seen.position_rad),
            "velocity_rad_s": by_name(kind, seen.velocity_rad_s),
            "effort_nm": by_name(kind, seen.effort_nm),
            "frames": dict(zip(kind.frames, seen.frames, strict=False)),
            "mode": str(self._body.controller.mode),
            "streams": {stream: _shown(reading) for stream, reading in self._body.reported().items()},
        }

    def _latest(self, device: str, stream: str) -> dict[str, Any] | None:
        reading = self._body.room.latest(device, stream)
        return None if reading is None else _shown(reading)


def _shown(reading: Reading) -> dict[str, Any]:
    return {"values": dict(reading.values), "age_s": reading.age_s}


def _nobody(_: Refused) -> None:
    """Nobody is told."""
