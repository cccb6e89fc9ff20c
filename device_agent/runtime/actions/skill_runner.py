"""What a robot shows: speech, expressions, postures, behaviours, stiffness. By its manifest, or by its driver."""

import contextlib
import threading
import time
from typing import Protocol

from device_agent.ports import skills
from device_agent.ports.skills import Skill, SkillError
from device_agent.protocol import Express, RunBehaviour, Say, SetStiffness, TakePosture
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.speech_output import Utterance
from device_agent.runtime.authority.authority import Reservation
from device_agent.runtime.control.goals import MotionGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import named_poses
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory, Line

_REST_WITHIN_S = 3.0
_PERIODS = 4
"""Control periods after which the servos surely have what was commanded."""


class JointMover(Protocol):
    """The action that shows something."""

    tenure: Reservation
    over: threading.Event

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        """Move and wait until there [rad].

        Raises:
            Refused: It did not get there.
        """

    def follow(self, course: MotionGoal) -> None:
        """Wait for the end of a course.

        Raises:
            Refused: It was interrupted.
        """


class SkillRunner:
    """Shows what one action asks for.

    Args:
        body: The device.
        mover: The action.
    """

    def __init__(self, body: DeviceContext, mover: JointMover) -> None:
        self._body = body
        self._mover = mover

    def show(self, skill: Skill) -> None:
        """Execute a skill to its end, by the driver if it supports the skill.

        Raises:
            Refused: It was not done.
        """
        kind = self._body.robot_type
        match skill:
            case Express(name=name, strength=strength) if not self._body.performs(skills.EXPRESSIONS):
                self._mover.move_joints(named_poses.expression(kind, name, strength), named_poses.EXPRESSION_SPEED)
            case TakePosture(name=name, speed=speed) if not self._body.performs(skills.POSTURES):
                self._mover.move_joints(named_poses.posture(kind, name), speed)
            case RunBehaviour(name=name) if not self._body.performs(skills.BEHAVIOURS):
                self._behave(name)
            case Say(text=text, language=language) if not self._body.performs(skills.SPEECH):
                self._say(text, language)
            case SetStiffness():
                self._stiffen(skill)
            case _:
                self.perform(skill)

    def perform(self, skill: Skill) -> None:
        """Have the driver do it, to its end.

        Raises:
            Refused: It cannot, or the action has lost the device.
        """
        if self._body.skills is None:
            raise Refused("cannot", "this robot's driver has no skills")
        if not self._mover.over.is_set():
            try:
                self._body.skills.perform(skill, _SkillContext(self._mover))
            except SkillError as error:
                raise self._mover.tenure.why or Refused("skill_failed", str(error)) from error
        self._check()

    # ------------------------------------------------------------ speech and behaviours

    def _say(self, text: str, language: str) -> None:
        utterance = self._body.speaker.prepare(text, language)
        kind = self._body.robot_type
        if not kind.visemes:
            self._body.speaker.begin(utterance)
            self._mover.over.wait(utterance.duration_s)
            self._check()
            return
        self.come_to_rest()
        score = BehaviourTrajectory(kind, self._body.controller.commanded_rad)
        score.speak(Line(0.0, text, utterance.duration_s))
        course = self._body.controller.go_along(self._mover.tenure, score.way())
        self._body.speaker.begin(utterance)
        self._mover.follow(course)

    def _behave(self, name: str) -> None:
        kind = self._body.robot_type
        keyframes = named_poses.named("behaviour", name, kind.behaviours)
        said = {one.say: self._body.speaker.prepare(one.say, "") for one in keyframes if one.say}
        self.come_to_rest()
        score = BehaviourTrajectory(kind, self._body.controller.commanded_rad)
        lines = score.keyframes(keyframes, {text: utterance.duration_s for text, utterance in said.items()})
        course = self._body.controller.go_along(self._mover.tenure, score.way())
        begun_s = time.monotonic()
        for line in lines:
            if course.finished.wait(max(0.0, begun_s + line.begin_s - time.monotonic())):
                break
            self._speak(said[line.text])
        self._mover.follow(course)

    def _speak(self, utterance: Utterance) -> None:
        """While something moves."""
        self._body.speaker.begin(utterance)
        if self._body.performs(skills.SPEECH):
            threading.Thread(target=self._aloud, args=(utterance.text,), name="speech", daemon=True).start()

    def _aloud(self, text: str) -> None:
        with contextlib.suppress(Refused):  # the words of a behaviour that is over, or of a robot that lost its voice
            self.perform(Say(text=text))

    # ------------------------------------------------------------ stiffness

    def _stiffen(self, order: SetStiffness) -> None:
        """While servos change their strength their joints are commanded to where they are: nothing jumps or drops."""
        controller = self._body.controller
        held = before = controller.stiffness(order.joints)
        self.come_to_rest()
        controller.stiffen(self._mover.tenure, dict.fromkeys(before, 0.0))
        try:
            self._mover.over.wait(_PERIODS * self._body.robot_type.period_ms / 1000)
            self.perform(order)
            held = dict.fromkeys(before, order.value)
            self._mover.over.wait(_PERIODS * self._body.robot_type.period_ms / 1000)
        finally:
            controller.stiffened(held)

    # ------------------------------------------------------------ for all of them

    def come_to_rest(self) -> None:
        """Wait for what the action before left in motion: it brakes by itself.

        Raises:
            Refused: The action has lost the device.
        """
        until_s = time.monotonic() + _REST_WITHIN_S
        while self._body.controller.moving and time.monotonic() < until_s:
            self._mover.over.wait(self._body.robot_type.period_ms / 1000)
            self._check()

    def _check(self) -> None:
        if self._mover.over.is_set():
            raise self._mover.tenure.why or Refused("ended", "the action ended")


class _SkillContext:
    """``Stage`` of one skill."""

    def __init__(self, mover: JointMover) -> None:
        self._mover = mover

    @property
    def ended(self) -> bool:
        """See ``Stage``."""
        return self._mover.over.is_set()

    def wait(self, timeout_s: float) -> bool:
        """See ``Stage``."""
        return self._mover.over.wait(timeout_s)

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        """See ``Stage``."""
        try:
            self._mover.move_joints(position_rad, speed)
        except Refused as refused:
            raise SkillError(refused.message) from refused
