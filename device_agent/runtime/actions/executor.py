"""Runs one action at a time on one device, in a thread of its own, and reports each step of it as an ack."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

from device_agent.ports.sandbox import Sandbox
from device_agent.protocol import AckStatus, ActionState, Command, Reason, RoomTask, RunMovement, Task
from device_agent.runtime.actions import call_action
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.actions.script_action import MAX_OUTPUT, Cell, Script, ScriptFailed
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.errors import Refused
from device_agent.runtime.room import room_actions

Report = Callable[..., None]
"""``report(command_id, status, reason=…, progress=…, output=…, result=…)``: journal and publish one ack."""
Order = RunMovement | Task
"""What is an action."""

_TELL_EVERY_S = 0.2
_log = logging.getLogger(__name__)


class ActionExecutor:
    """The one action of one device. Thread-safe.

    Args:
        body: The device.
        trust: Judges scripts.
        jail: Where they run.
        report: Journals and publishes an ack.
        settle: Sees to it that what was journalled is on the disk; raises where it cannot be.
    """

    def __init__(
        self, body: DeviceContext, *, trust: ScriptPolicy, jail: Sandbox, report: Report, settle: Callable[[], None]
    ) -> None:
        self._settle = settle
        self._body = body
        self._trust = trust
        self._jail = jail
        self._report = report
        self._lock = threading.Lock()
        self._run: _Run | None = None

    def start(self, command: Command, order: Order) -> None:
        """Begin the action of a command that has been accepted; its acks follow by themselves.

        Raises:
            Refused: The device is busy, stopped or faulty, the lease is stale, the script is not what was signed or
                older than one that ran, or this machine cannot lock it in.
        """
        with self._lock:
            if self._run is not None:
                raise Refused("busy", f"action {self._run.command.id} runs on this device")
            run = _Run(command, self._body, self._report, self._settle)
            if isinstance(order, RunMovement):
                cell = self._cell(order)
                run.begin(_Playing(order, run, cell))
                self._trust.remember(order)
            elif isinstance(order, RoomTask):
                run.begin(room_actions.activity(order, self._body.instrument, run.tell))
            else:
                run.begin(call_action.CallAction(order, run.robot))
            self._run = run
        threading.Thread(target=self._follow, args=(run,), name=f"action-{command.id}", daemon=True).start()
        run.announce()

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

    def _cell(self, order: RunMovement) -> Cell:
        """Where a script may run, once it is seen to be what it should be."""
        self._trust.check(order)
        stranger = self._trust.stranger(order)
        refusal = self._jail.refusal(stranger=stranger)
        if refusal is not None:
            raise Refused("no_jail", refusal)
        return Cell(self._jail, stranger)

    def _follow(self, run: "_Run") -> None:
        try:
            run.play()
        finally:
            run.robot.give_back()
            with self._lock:
                self._run = None
            run.tell_end()


class _Activity(Protocol):
    """What an action does."""

    def run(self) -> dict[str, Any]:
        """Do it to its end; gives what there is to tell besides."""

    def kill(self) -> None:
        """End it, from any thread; never blocks. May be called twice."""


class _Playing:
    """An action that is a script, and its time."""

    def __init__(self, order: RunMovement, run: "_Run", cell: Cell) -> None:
        self._script = Script(order, run.robot, run.tell, cell=cell, died=run.robot.give_back)
        self._timeout_s = order.timeout_ms / 1000
        self._robot, self._end = run.robot, run.end

    def kill(self) -> None:
        """See ``_Activity``."""
        self._script.kill()

    def run(self) -> dict[str, Any]:
        """See ``_Activity``."""
        why = Refused("too_long", f"the movement was ended after its {self._timeout_s:g} s")
        alarm = threading.Timer(self._timeout_s, self._end, (AckStatus.FAILED, why))
        alarm.daemon = True
        alarm.start()
        try:
            self._script.run()
        finally:
            alarm.cancel()
        return {"limited": self._robot.limited} if self._robot.limited else {}


class _Run:
    """One action from begin to end.

    Args:
        command: What is to be done.
        body: The device.
        report: Journals and publishes an ack.
        settle: See ``ActionExecutor``.
    """

    def __init__(self, command: Command, body: DeviceContext, report: Report, settle: Callable[[], None]) -> None:
        self._settle = settle
        self.command = command
        self.over = threading.Event()
        self._announced = threading.Event()
        self.robot = RobotApi(body)
        self._body = body
        self._report = report
        self._ending: tuple[AckStatus, Refused] | None = None
        self._result: dict[str, Any] = {}
        self._output = ""
        self._progress: float | None = None
        self._told_at_s = 0.0
        self._activity: _Activity

    def begin(self, activity: _Activity) -> None:
        """Take the device, for this activity.

        Raises:
            Refused: It cannot be taken.
        """
        self._activity = activity
        self.robot.begin(self.command.epoch, self._lost)

    def announce(self) -> None:
        """Tell that it has begun, while its own thread comes up and sees to the disk: somebody waits to hear it."""
        self._attempt(lambda: self._report(self.command.id, AckStatus.STARTED))
        self._announced.set()

    def play(self) -> None:
        """Do it; returns when it is over, however it ended."""
        self._attempt(self._settle)  # before anything moves: what has moved once must not be run again
        self._announced.wait()
        if self._ending is None:
            self._attempt(self._do)

    def _do(self) -> None:
        self._result = self._activity.run()

    def _attempt(self, step: Callable[[], None]) -> None:
        try:
            step()
        except Refused as refused:
            self.end(AckStatus.FAILED, refused)
        except ScriptFailed as failed:
            self.end(AckStatus.FAILED, Refused("script_failed", str(failed)))
        except Exception as error:  # noqa: BLE001 (whatever it was: what was not done must not be told as done)
            _log.exception("action %s", self.command.id)
            self.end(AckStatus.FAILED, Refused("internal", f"internal error: {error}; look at the agent's log"))

    def end(self, status: AckStatus, why: Refused) -> None:
        """Bring it to an end, from any thread; the first reason stays."""
        self._ending = self._ending or (status, why)
        self.robot.give_back()
        self._activity.kill()

    def tell_end(self) -> None:
        """Report the end."""
        result = self._body.measured() | self._result
        if self._ending is None:
            self._report(self.command.id, AckStatus.DONE, output=self._output, progress=1.0, result=result)
        else:
            status, why = self._ending
            reason = Reason(code=why.code, message=why.message[:MAX_OUTPUT])
            self._report(self.command.id, status, reason=reason, output=self._output, result=result)
        self.over.set()

    def state(self) -> ActionState:
        """As the device's ``state`` shows it."""
        request = self.command.request
        kind, name = str(type(request).__struct_config__.tag), getattr(request, "name", "")
        return ActionState(id=self.command.id, kind=kind, name=name, progress=self._progress or 0.0)

    def _lost(self, why: Refused) -> None:
        # The controller calls this with its lock held: no call back into it from here.
        self._ending = self._ending or (AckStatus.FAILED, why)
        self.robot.end()
        self._activity.kill()

    def tell(self, text: str, progress: float | None) -> None:
        """Take in what a script printed, and how far it says it is."""
        self._output = (self._output + text)[-MAX_OUTPUT:]
        if progress is not None:
            self._progress = progress
        now_s = time.monotonic()
        if now_s - self._told_at_s >= _TELL_EVERY_S:
            self._told_at_s = now_s
            self._report(self.command.id, AckStatus.STARTED, output=self._output, progress=self._progress)
