"""Device operations of one action: script calls and single tasks, while the action has reserved the device."""

import threading
from collections.abc import Callable, Mapping
from typing import Any

from device_agent.ports.driver import REST, Twist
from device_agent.ports.geometry import GeometryError, RobotGeometry
from device_agent.ports.script_calls import Call, GetLatest, GetState, Home, Play, Wait
from device_agent.protocol import Drive, GoTo, LookAt, MoveJoints, MovePose, RobotTask, SetControl
from device_agent.protocol.manifests.task_kinds import tag
from device_agent.runtime.actions.device_context import SCRIPT_NAMES, DeviceContext, by_name
from device_agent.runtime.actions.skill_runner import SkillRunner
from device_agent.runtime.authority.authority import Reservation
from device_agent.runtime.control.goals import GoalResult, MotionGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import gaze
from device_agent.runtime.planning.keyframe_trajectory import MAX_SPEED, KeyframeTrajectory
from device_agent.runtime.planning.localization import ODOMETRY, POSITIONS, Pose2D
from device_agent.runtime.planning.motion_planner import MotionPlanner, quaternion_of
from device_agent.runtime.planning.navigator import MAX_APPROACHES, SETTLE_UPDATES, UPDATE_PERIOD_S, Navigator
from device_agent.runtime.readings import Reading

UNSEEN_TIMEOUT_S = 5.0
"""Time for which a robot rests while the room's sensors do not see it, for example because of a person [s]."""


class RobotApi:
    """``RobotApiProtocol`` of one action.

    Attributes:
        limited: Limits that changed the motion so far, as telemetry names them.
        skill_runner: Executes skills.
        reservation: The action's reservation of the device.
        ended: Set when the action has ended or its reservation was revoked.
        calls: Names of the script API's methods that the robot supports.
    """

    def __init__(self, context: DeviceContext) -> None:
        self._context = context
        self.reservation = Reservation(epoch=-1, on_revoked=lambda _: None)  # a placeholder until ``reserve``
        self.ended = threading.Event()
        self.joints = tuple(joint.name for joint in context.robot_type.joints)
        self.frames = () if context.geometry is None else tuple(context.geometry.frames)
        self.calls = context.script_calls()
        self._supported = context.supported()
        self.limited: tuple[str, ...] = ()
        self.skill_runner = SkillRunner(context, self)

    def reserve(self, epoch: int, on_revoked: Callable[[Refused], None], *, recovery: bool = False) -> None:
        """Reserve the device; see ``Controller.reserve``. ``on_revoked`` is called with the controller locked.

        Raises:
            Refused: The device cannot be reserved.
        """
        self.reservation = self._context.controller.reserve(epoch=epoch, on_revoked=on_revoked, recovery=recovery)

    def end(self) -> None:
        """End running skills. Never blocks."""
        self.ended.set()

    def release(self) -> None:
        """Release the device; a motion in progress brakes."""
        self.end()
        self._context.controller.end_reservation(self.reservation)

    def execute(self, call: Call) -> Any:
        """See ``RobotApiProtocol``."""
        self._check_supported(call)
        match call:
            case MoveJoints(position_rad=position_rad, speed=speed, plan=plan):
                self.move_joints(position_rad, speed, plan=plan)
            case Play():
                self._play(call)
            case Home(speed=speed):
                self.move_joints(self._context.robot_type.home_rad, speed)
            case MovePose():
                self._move_pose(call)
            case Drive():
                self._drive(call)
            case GoTo():
                self._go_to(call)
            case LookAt():
                self._look_at(call)
            case SetControl() | Wait() | GetState() | GetLatest():
                return self._respond(call)
            case _:
                self.skill_runner.run(call)
        return None

    def _respond(self, call: SetControl | Wait | GetState | GetLatest) -> Any:
        """Execute a call that moves neither joints nor the base."""
        match call:
            case SetControl():
                robot = self._context.controls
                return robot and self.skill_runner.set_control(call, robot)["applied"][call.control]
            case Wait(duration_s=duration_s):
                return self.ended.wait(duration_s)
            case GetState():
                return self._state()
        return self._latest(call.device, call.stream)

    def execute_task(self, task: RobotTask) -> dict[str, Any]:
        """Execute a single task to its end; losing the reservation ends it. Returns ``limits``."""
        self.execute(task)
        return self.limits()

    def limits(self) -> dict[str, Any]:
        """The part of a result that lists what limited the motion."""
        return {"limited": self.limited} if self.limited else {}

    def _check_supported(self, call: Call) -> None:
        if type(call) not in self._supported:
            name = SCRIPT_NAMES.get(type(call), tag(type(call)))
            raise Refused("cannot", f"this robot has no {name}; it has {', '.join(self.calls)}")

    def move_joints(self, position_rad: Mapping[str, float], speed: float, *, plan: bool = False) -> None:
        """Move to joint positions [rad] and wait; with ``plan``, around obstacles.

        Raises:
            Refused: The robot did not reach the positions.
        """
        controller = self._context.controller
        if plan:
            planner = MotionPlanner(self._context.robot_type, self._geometry())
            goal_rad = controller.resolve_target(self.reservation, position_rad)
            start_rad = controller.commanded_rad
            trajectory = planner.plan(start_rad, goal_rad, speed=speed, ended=self.ended.is_set)
            self.wait_for(controller.start_trajectory(self.reservation, trajectory))
        else:
            self.wait_for(controller.start_joint_goal(self.reservation, dict(position_rad), speed=speed))

    def _play(self, call: Play) -> None:
        if not 0 < call.speed <= MAX_SPEED:  # false for NaN
            raise Refused("bad_speed", f"speed must be above 0 and at most {MAX_SPEED:g}, not {call.speed}")
        self.skill_runner.wait_for_rest()
        controller = self._context.controller
        keyframes = KeyframeTrajectory(self._context.robot_type, controller.commanded_rad, call)
        for number, pose in enumerate(keyframes.poses(), call.first):
            try:
                controller.resolve_target(self.reservation, pose)
            except Refused as refused:
                raise Refused(refused.code, f"keyframe {number}: {refused.message}") from refused
        goal = controller.start_trajectory(self.reservation, keyframes.trajectory())
        goal.add_limits(keyframes.limited)
        self.wait_for(goal)

    def _move_pose(self, call: MovePose) -> None:
        if call.straight and call.plan:
            raise Refused("bad_way", "a motion is straight or planned, not both")
        controller, geometry = self._context.controller, self._geometry()
        start = controller.commanded_rad
        frame = call.frame or geometry.frames[-1]
        w, x, y, z = quaternion_of(geometry.poses(start), frame, call.quaternion, call.rpy_rad)
        pose = (*call.position_m, w, x, y, z)
        if call.straight:
            planner = MotionPlanner(self._context.robot_type, geometry)
            trajectory = planner.plan_straight(start, frame, pose, speed=call.speed)
            self.wait_for(controller.start_trajectory(self.reservation, trajectory))
            return
        try:
            solution = geometry.solve(frame, pose, start)
        except GeometryError as error:
            raise Refused("out_of_reach", str(error)) from error
        self.move_joints(by_name(self._context.robot_type, solution), call.speed, plan=call.plan)

    def _drive(self, call: Drive) -> None:
        twist = Twist(call.forward_m_s, call.left_m_s, call.turn_rad_s)
        self.wait_for(self._context.controller.start_drive(self.reservation, twist, duration_s=call.duration_s))

    def _go_to(self, call: GoTo) -> None:
        """Approach the goal, and repeat it if the pose at rest shows that the robot is not there."""
        context = self._context
        navigator = Navigator.for_robot(call.x_m, call.y_m, call.yaw_rad, context.robot_type)
        context.pose_estimator.start(navigator.max_speed_m_s)
        for _ in range(MAX_APPROACHES):
            self._approach(navigator)
            pose = self._measure_at_rest()
            if navigator.is_near(pose):
                return
        navigator.require_arrival(pose)

    def _measure_at_rest(self) -> Pose2D:
        """The pose after the robot has come to rest: positions from the room arrive late.

        Raises:
            Refused: The room's sensors contradict the pose, or do not see the robot.
        """
        for update in range(1, SETTLE_UPDATES + 1):
            self.wait_for(self._context.controller.start_drive(self.reservation, REST, duration_s=UPDATE_PERIOD_S))
            pose = self._pose(confirm=update == SETTLE_UPDATES)
        return pose

    def _pose(self, *, confirm: bool = False, on_rest: Callable[[], None] | None = None) -> Pose2D:
        """The pose. If the room's sensors do not see the robot, it rests for a while: a person may stand before them.

        Args:
            confirm: Whether the room must see the robot now.
            on_rest: Called in each period of this rest.

        Raises:
            Refused: The pose stays unknown, or the room's sensors contradict it.
        """
        unseen_s = 0.0
        while True:
            try:
                return self._estimate_pose(confirm=confirm)
            except Refused as refused:
                rest = self._context.controller.start_drive(self.reservation, REST, duration_s=UPDATE_PERIOD_S)
                if refused.code != "no_position" or unseen_s >= UNSEEN_TIMEOUT_S:
                    raise
                unseen_s += UPDATE_PERIOD_S
                if on_rest is not None:
                    on_rest()
                self.wait_for(rest)

    def _estimate_pose(self, *, confirm: bool) -> Pose2D:
        context = self._context
        room = context.readings.newest(POSITIONS, f"x_m.{context.name}")
        odometry = context.own_readings().get(ODOMETRY)
        return context.pose_estimator.estimate(context.name, odometry, room, confirm=confirm)

    def _approach(self, navigator: Navigator) -> None:
        """Drive by drives of limited duration: if this loop stops, the robot stops."""
        context, controller = self._context, self._context.controller
        waited_s = 0.0
        while not self.ended.is_set():
            obstacle_map = None if context.obstacle_map is None else context.obstacle_map()
            if obstacle_map is None:
                raise Refused("no_ground", "no sensor reports the obstacles in the room; drive manually")
            pose = self._pose(on_rest=navigator.replan)
            try:
                twist, waited_s = navigator.compute_twist(pose, obstacle_map), 0.0
            except Refused as refused:
                waited_s += UPDATE_PERIOD_S
                if waited_s > navigator.timeout_s(refused):
                    raise
                twist = REST
            if twist is None:
                break
            drive = controller.start_drive(self.reservation, twist, duration_s=3 * UPDATE_PERIOD_S)
            if drive.finished.wait(UPDATE_PERIOD_S):
                self.wait_for(drive)

    def wait_for(self, goal: MotionGoal) -> None:
        """Start the control period of a goal, and wait for the goal's end.

        Raises:
            Refused: The goal was interrupted.
        """
        self._context.wake()
        goal.finished.wait()
        self.limited += tuple(limit for limit in goal.limited if limit not in self.limited)
        if goal.result is not GoalResult.REACHED:
            raise goal.why or Refused("interrupted", "the motion was interrupted")

    def _look_at(self, call: LookAt) -> None:
        if self._context.robot_type.gaze is None:
            self.skill_runner.perform(call)
        else:
            start_rad = self._context.observation().position_rad
            target = gaze.solve_gaze(self._context.robot_type, self._geometry(), start_rad, call.position_m)
            self.move_joints(target, call.speed)

    def _geometry(self) -> RobotGeometry:
        if self._context.geometry is None:
            raise Refused("no_model", "this robot's type has no model")
        return self._context.geometry

    def _state(self) -> dict[str, Any]:
        observation, robot_type = self._context.observation(), self._context.robot_type
        return {
            "position_rad": by_name(robot_type, observation.position_rad),
            "velocity_rad_s": by_name(robot_type, observation.velocity_rad_s),
            "effort_nm": by_name(robot_type, observation.effort_nm),
            "frames": dict(zip(robot_type.frames, observation.frames, strict=False)),
            "mode": str(self._context.controller.mode),
            "streams": {stream: _to_dict(reading) for stream, reading in self._context.own_readings().items()},
        }

    def _latest(self, device: str, stream: str) -> dict[str, Any] | None:
        reading = self._context.readings.latest(device, stream)
        return None if reading is None else _to_dict(reading)


def _to_dict(reading: Reading) -> dict[str, Any]:
    return {"values": dict(reading.values), "age_s": reading.age_s}
