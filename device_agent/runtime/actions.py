"""Runs one action at a time on one device, in a thread of its own, and reports each step of it as an ack."""

import hashlib
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from device_agent.ports.driver import Observation
from device_agent.protocol.messages import AckStatus, ActionState, Command, MoveJoints, Reason, RunMovement
from device_agent.protocol.robot_type import RobotType
from device_agent.runtime.authority import Tenure
from device_agent.runtime.controller import Controller
from device_agent.runtime.courses import Outcome
from device_agent.runtime.lease import Refused
from device_agent.runtime.movements import MAX_OUTPUT, Script, ScriptFailed

Report = Callable[..., None]
"""``report(command_id, status, reason=…, progress=…, output=…, result=…)``: journal and publish one ack."""

_TELL_EVERY_S = 0.2


class Executor:
    """The one action of one device. Thread-safe.

    Args:
        robot_type: Names and home position of the joints.
        controller: What moves the device.
        observe: The newest measurement, or ``None`` before the first.
        report: Journals and publishes an ack.
    """

    def __init__(
        self,
        robot_type: RobotType,
        controller: Controller,
        *,
        observe: Callable[[], Observation | None],
        report: Report,
    ) -> None:
        self._robot_type = robot_type
        self._controller = controller
        self._observe = observe
        self._report = report
        self._lock = threading.Lock()
        self._run: _Run | None = None

    def start(self, command: Command) -> None:
        """Begin the action of a command that has been accepted; its acks follow by themselves.

        Raises:
            Refused: The device is busy, stopped or faulty, the lease is stale, or the script is not what was signed.
        """
        with self._lock:
            if self._run is not None:
                raise Refused("busy", f"action {self._run.command.id} runs on this device")
            run = _Run(command, self._robot_type, self._controller, self._observe, self._report)
            run.begin()
            self._run = run
        threading.Thread(target=self._follow, args=(run,), name=f"action-{command.id}", daemon=True).start()

    def cancel(self, action: str, who: str) -> None:
        """End the named action; the device holds.

        Raises:
            Refused: That action does not run here.
        """
        with self._lock:
            run = self._run
        if run is None or run.command.id != action:
            raise Refused("not_running", f"action {action} does not run on this device")
        run.end(AckStatus.CANCELLED, Refused("cancelled", f"cancelled by {who}"))

    def current(self) -> ActionState | None:
        """The action that runs now."""
        with self._lock:
            return None if self._run is None else self._run.state()

    def close(self) -> None:
        """End what runs; the agent is going down."""
        with self._lock:
            run = self._run
        if run is not None:
            run.end(AckStatus.FAILED, Refused("agent_stopping", "the agent was shut down"))
            run.over.wait(timeout=2)

    def _follow(self, run: "_Run") -> None:
        try:
            run.play()
        finally:
            run.give_back()
            with self._lock:
                self._run = None
            run.tell_end()


class _Run:
    """One action from begin to end."""

    def __init__(
        self,
        command: Command,
        robot_type: RobotType,
        controller: Controller,
        observe: Callable[[], Observation | None],
        report: Report,
    ) -> None:
        self.command = command
        self.over = threading.Event()
        self._robot_type = robot_type
        self._controller = controller
        self._observe = observe
        self._report = report
        self._tenure: Tenure | None = None
        self._script: Script | None = None
        self._ending: tuple[AckStatus, Refused] | None = None
        self._output = ""
        self._progress: float | None = None
        self._told_at_s = 0.0

    def begin(self) -> None:
        """Check the order and take the device."""
        order = self.command.request
        if isinstance(order, RunMovement):
            if hashlib.sha256(order.source.encode()).hexdigest() != order.sha256:
                raise Refused("wrong_hash", "the script is not the one that was signed for")
            if order.robot_type != self._robot_type.type:
                raise Refused("wrong_type", f"a movement of '{order.robot_type}', not of '{self._robot_type.type}'")
        self._tenure = self._controller.begin_action(epoch=self.command.epoch, on_lost=self._lost)
        self._robot = _Robot(self._robot_type, self._controller, self._tenure, self._observe)
        if isinstance(order, RunMovement):
            self._script = Script(order, self._robot, self._tell)

    def play(self) -> None:
        """Do it; returns when it is over, however it ended."""
        self._report(self.command.id, AckStatus.STARTED)
        order = self.command.request
        try:
            if self._script is not None:
                self._script.run()
            elif isinstance(order, MoveJoints):
                self._robot.move_joints(dict(order.position_rad), order.speed)
        except Refused as refused:
            self.end(AckStatus.FAILED, refused)
        except ScriptFailed as failed:
            self.end(AckStatus.FAILED, Refused("script_failed", str(failed)))

    def end(self, status: AckStatus, why: Refused) -> None:
        """Bring it to an end, from any thread; the first reason stays."""
        if self._ending is None:
            self._ending = (status, why)
        self.give_back()
        if self._script is not None:
            self._script.kill()

    def give_back(self) -> None:
        """Leave the device; what still moves is held."""
        if self._tenure is not None:
            self._controller.end_action(self._tenure)

    def tell_end(self) -> None:
        """Report the end."""
        seen = self._observe()
        result = {} if seen is None else {"position_rad": by_name(self._robot_type, seen.position_rad)}
        if self._ending is None:
            self._report(self.command.id, AckStatus.DONE, output=self._output, progress=1.0, result=result)
        else:
            status, why = self._ending
            reason = Reason(code=why.code, message=why.message[:MAX_OUTPUT])
            self._report(self.command.id, status, reason=reason, output=self._output, result=result)
        self.over.set()

    def state(self) -> ActionState:
        """As the device's ``state`` shows it."""
        order = self.command.request
        name = order.name if isinstance(order, RunMovement) else ""
        kind = "run_movement" if isinstance(order, RunMovement) else "move_joints"
        return ActionState(id=self.command.id, kind=kind, name=name, progress=self._progress or 0.0)

    def _lost(self, why: Refused) -> None:
        # The controller calls this with its lock held: no call back into it from here.
        if self._ending is None:
            self._ending = (AckStatus.FAILED, why)
        if self._script is not None:
            self._script.kill()

    def _tell(self, text: str, progress: float | None) -> None:
        self._output = (self._output + text)[-MAX_OUTPUT:]
        if progress is not None:
            self._progress = progress
        now_s = time.monotonic()
        if now_s - self._told_at_s >= _TELL_EVERY_S:
            self._told_at_s = now_s
            self._report(self.command.id, AckStatus.STARTED, output=self._output, progress=self._progress)


class _Robot:
    """What a script's calls reach, for as long as its action has the device."""

    def __init__(
        self,
        robot_type: RobotType,
        controller: Controller,
        tenure: Tenure,
        observe: Callable[[], Observation | None],
    ) -> None:
        self._robot_type = robot_type
        self._controller = controller
        self._tenure = tenure
        self._observe = observe

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self._robot_type.joints)

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        move = self._controller.move(self._tenure, position_rad, speed=speed)
        move.finished.wait()
        if move.outcome is not Outcome.REACHED:
            raise move.why or Refused("interrupted", "the move was interrupted")

    def home(self, speed: float) -> None:
        self.move_joints(dict(self._robot_type.home_rad), speed)

    def state(self) -> dict[str, Any]:
        seen = self._observe()
        if seen is None:
            raise Refused("no_measurement", "the robot has not been measured yet")
        return {
            "position_rad": by_name(self._robot_type, seen.position_rad),
            "velocity_rad_s": by_name(self._robot_type, seen.velocity_rad_s),
            "effort_nm": by_name(self._robot_type, seen.effort_nm),
            "mode": str(self._controller.mode),
        }


def by_name(robot_type: RobotType, values: Sequence[float]) -> dict[str, float]:
    """Values in joint order as joint name → value."""
    return dict(zip((joint.name for joint in robot_type.joints), values, strict=True))
