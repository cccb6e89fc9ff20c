"""Skills: speech, expressions, postures, behaviours and stiffness, executed by the manifest or by the driver."""

import contextlib
import threading
import time
from functools import partial
from typing import Any, Protocol

from device_agent.ports.skills import HasBehaviours, HasControls, Skill, SkillError
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol import Express, RunBehaviour, Say, SetControl, SetStiffness, TakePosture
from device_agent.protocol.manifests import task_kinds
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.speech_output import Utterance
from device_agent.runtime.authority.authority import Reservation
from device_agent.runtime.control.goals import MotionGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import named_poses
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory, SpokenLine
from device_agent.runtime.room.controls import check_value

_REST_TIMEOUT_S = 3.0
_SETTLE_PERIODS = 4
"""Control periods after which the servos have received a command."""


class JointMover(Protocol):
    """The action that runs a skill."""

    reservation: Reservation
    ended: threading.Event

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        """Move to joint positions [rad] and wait."""

    def wait_for(self, goal: MotionGoal) -> None:
        """Wait for the end of a goal."""


class SkillRunner:
    """Runs the skills of one action."""

    def __init__(self, context: DeviceContext, mover: JointMover) -> None:
        self._context = context
        self._mover = mover

    def run(self, skill: Skill) -> None:
        """Run a skill to its end, by the driver if the driver supports it.

        Raises:
            Refused: The skill failed.
        """
        robot_type, by_driver = self._context.robot_type, self._context.performs
        match skill:
            case Express(name=name, strength=strength) if not by_driver(task_kinds.EXPRESSIONS):
                target = named_poses.expression(robot_type, name, strength)
                self._mover.move_joints(target, named_poses.EXPRESSION_SPEED)
            case TakePosture(name=name, speed=speed) if not by_driver(task_kinds.POSTURES):
                self._mover.move_joints(named_poses.posture(robot_type, name), speed)
            case RunBehaviour(name=name) if name not in robot_type.behaviours and self._context.behaviours is not None:
                self._run_robot_behaviour(name, self._context.behaviours)
            case RunBehaviour(name=name) if not by_driver(task_kinds.BEHAVIOURS):
                self._run_behaviour(name)
            case Say(text=text, language=language) if not by_driver(task_kinds.SPEECH):
                self._say(text, language)
            case SetStiffness():
                self._set_stiffness(skill)
            case _:
                self.perform(skill)

    def perform(self, skill: Skill) -> None:
        """Run a skill by the driver, to its end.

        Raises:
            Refused: The driver cannot run it, or the action has ended.
        """
        if self._context.skills is None:
            raise Refused("cannot", "this robot's driver has no skills")
        if not self._mover.ended.is_set():
            try:
                self._context.skills.perform(skill, _SkillContext(self._mover))
            except SkillError as error:
                raise self._mover.reservation.why or Refused("skill_failed", str(error)) from error
        self._check_running()

    def set_control(self, request: SetControl, robot: HasControls) -> dict[str, Any]:
        """Set a value of the robot; returns the ``applied`` one for the result.

        Raises:
            Refused: Unknown, out of range, not confirmed by the robot, or the action has ended.
        """
        check_value(robot.controls, request.control, request.value)
        try:
            applied = robot.set_control(request.control, request.value, _SkillContext(self._mover))
        except SkillError as error:
            raise self._mover.reservation.why or Refused("skill_failed", str(error)) from error
        self._check_running()
        return {"applied": {request.control: applied}}

    # ------------------------------------------------------------ speech and behaviours

    def _say(self, text: str, language: str) -> None:
        speech = self._context.speech
        utterance = speech.prepare(text, language)
        if not self._context.robot_type.visemes:
            speech.start(utterance)
            self._mover.ended.wait(utterance.duration_s)
            self._check_running()
            return
        self.wait_for_rest()
        behaviour = BehaviourTrajectory(self._context.robot_type, self._context.controller.commanded_rad)
        behaviour.add_speech(SpokenLine(0.0, text, utterance.duration_s))
        goal = self._context.controller.start_trajectory(self._mover.reservation, behaviour.trajectory())
        speech.start(utterance)
        self._mover.wait_for(goal)

    def _run_behaviour(self, name: str) -> None:
        robot_type, controller = self._context.robot_type, self._context.controller
        keyframes = named_poses.find("behaviour", name, robot_type.behaviours)
        utterances = {
            keyframe.say: self._context.speech.prepare(keyframe.say, "") for keyframe in keyframes if keyframe.say
        }
        self.wait_for_rest()
        behaviour = BehaviourTrajectory(robot_type, controller.commanded_rad)
        durations_s = {text: utterance.duration_s for text, utterance in utterances.items()}
        lines = behaviour.add_keyframes(keyframes, durations_s)
        goal = controller.start_trajectory(self._mover.reservation, behaviour.trajectory())
        start_s = time.monotonic()
        for line in lines:
            if goal.finished.wait(max(0.0, start_s + line.start_s - time.monotonic())):
                break
            self._start_line(utterances[line.text])
        self._mover.wait_for(goal)

    def _run_robot_behaviour(self, name: str, robot: HasBehaviours) -> None:
        """Let the robot run its own behaviour. It moves itself meanwhile, unless the behaviour is a recovery."""
        recovery, controller = self._context.is_recovery(name), self._context.controller
        if not recovery:
            self.wait_for_rest()
            controller.hand_over(self._mover.reservation)
        try:
            robot.run_behaviour(name, _SkillContext(self._mover))
        except SkillError as error:
            raise self._mover.reservation.why or Refused("skill_failed", str(error)) from error
        finally:
            if not recovery:
                controller.take_over()
        self._check_running()

    def _start_line(self, utterance: Utterance) -> None:
        """Start to speak while the robot moves."""
        self._context.speech.start(utterance)
        if self._context.performs(task_kinds.SPEECH):
            speak = partial(self._speak_by_driver, utterance.text)
            SupervisedThread(speak, name="speech", part="speech", device=self._context.name).start()

    def _speak_by_driver(self, text: str) -> None:
        with contextlib.suppress(Refused):  # the behaviour has ended, or the driver cannot speak now
            self.perform(Say(text=text))

    # ------------------------------------------------------------ stiffness

    def _set_stiffness(self, request: SetStiffness) -> None:
        """Change the stiffness. Meanwhile the joints are commanded to their measured positions, so that none jumps."""
        controller = self._context.controller
        resulting = before = controller.stiffness_of(request.joints)
        self.wait_for_rest()
        controller.set_stiffness(dict.fromkeys(before, 0.0), reservation=self._mover.reservation)
        settle_s = _SETTLE_PERIODS * self._context.robot_type.period_ms / 1000
        try:
            self._mover.ended.wait(settle_s)
            self.perform(request)
            resulting = dict.fromkeys(before, request.value)
            self._mover.ended.wait(settle_s)
        finally:
            controller.set_stiffness(resulting)

    # ------------------------------------------------------------ shared

    def wait_for_rest(self) -> None:
        """Wait until the motion of the previous action has braked.

        Raises:
            Refused: The action has ended.
        """
        deadline_s = time.monotonic() + _REST_TIMEOUT_S
        while self._context.controller.moving and time.monotonic() < deadline_s:
            self._mover.ended.wait(self._context.robot_type.period_ms / 1000)
            self._check_running()

    def _check_running(self) -> None:
        if self._mover.ended.is_set():
            raise self._mover.reservation.why or Refused("ended", "the action ended")


class _SkillContext:
    """``SkillContext`` of one skill."""

    def __init__(self, mover: JointMover) -> None:
        self._mover = mover

    @property
    def ended(self) -> bool:
        return self._mover.ended.is_set()

    def wait(self, timeout_s: float) -> bool:
        return self._mover.ended.wait(timeout_s)

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        try:
            self._mover.move_joints(position_rad, speed)
        except Refused as refused:
            raise SkillError(refused.message) from refused
