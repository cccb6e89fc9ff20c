"""Executes one action at a time on one device, in its own thread, and acknowledges each step."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Protocol

from device_agent.ports.clock import wall_ms
from device_agent.ports.sandbox import Sandbox
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol import (
    AckStatus,
    ActionState,
    Command,
    Reason,
    RoomTask,
    RunBehaviour,
    RunMovement,
    RunTrial,
    SetControl,
    Task,
)
from device_agent.protocol.events import EventKind
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.actions.script_action import MAX_OUTPUT, ScriptAction, ScriptFailed, ScriptSandbox
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.actions.trial_action import TrialAction
from device_agent.runtime.authority.event_recorder import EventRecord, Severity
from device_agent.runtime.errors import Refused
from device_agent.runtime.room import room_actions

Report = Callable[..., None]
"""``report(command_id, status, recorded=…, reason=…, progress=…, output=…, result=…)``: journal and publish one ack."""
ActionRequest = RunMovement | RunTrial | Task

_PROGRESS_PERIOD_S = 0.2
_INTERNAL = Refused("internal", "the agent failed during the action; see the agent's log")
_log = logging.getLogger(__name__)


class ActionExecutor:
    """The running action of one device. Thread-safe."""

    def __init__(
        self,
        context: DeviceContext,
        *,
        policy: ScriptPolicy,
        sandbox: Sandbox,
        report: Report,
        sync: Callable[[], None],
    ) -> None:
        self._sync = sync
        self._context = context
        self._policy = policy
        self._sandbox = sandbox
        self._report = report
        self._lock = threading.Lock()
        self._run: _Run | None = None
        self._last: _Run | None = None

    def start(self, command: Command, request: ActionRequest) -> None:
        """Start the action of an accepted command. Its acks follow.

        Raises:
            Refused: The device is busy, stopped or faulty; the lease is stale; the script is modified or older
                than one that ran; or this machine has no sandbox.
        """
        with self._lock:
            if self._run is not None:
                raise Refused("busy", f"action {self._run.command.id} runs on this device")
            run = _Run(command, self._context, self._report, self._sync)
            if isinstance(request, RunMovement):
                run.reserve(_TimedActivity(_Script(self._script(request, run), run), request, run))
                self._policy.record_version(request)
            elif isinstance(request, RunTrial):
                trial = TrialAction(request, self._script(request.movement, run), run=run, context=self._context)
                run.reserve(_TimedActivity(trial, request.movement, run))
                self._policy.record_version(request.movement)
            elif isinstance(request, SetControl) and self._context.controls is not None:
                set_control = partial(run.robot.skill_runner.set_control, request, self._context.controls)
                run.reserve(room_actions.OneShotAction(set_control))
            elif isinstance(request, RoomTask):
                run.reserve(room_actions.create(request, self._context.room_device, run.add_output))
            else:
                run.reserve(room_actions.OneShotAction(partial(run.robot.execute_task, request)))
            self._run = self._last = run
        name, device = f"action-{command.id}", command.device
        SupervisedThread(partial(self._execute, run), name=name, part="action", device=device).start()
        run.report_started()

    def cancel(self, action: str, caller: str) -> None:
        """End the named action; the device holds.

        Raises:
            Refused: That action does not run here.
        """
        with self._lock:
            run = self._run
        if run is None or run.command.id != action:
            raise Refused("not_running", f"action {action} does not run on this device")
        run.end(AckStatus.CANCELLED, Refused("cancelled", f"cancelled by {caller}"))

    def current(self) -> ActionState | None:
        """The running action."""
        with self._lock:
            return None if self._run is None else self._run.state()

    @property
    def caller(self) -> str:
        """Name of the account that started the running action; empty if none runs."""
        run = self._run
        return "" if run is None else run.command.caller

    @property
    def idle(self) -> bool:
        """Whether no action runs, and the end of the last one is in the journal."""
        last = self._last
        return last is None or last.over.is_set()

    def close(self) -> None:
        """End the running action because the agent shuts down."""
        with self._lock:
            run = self._run
        if run is not None:
            run.end(AckStatus.FAILED, Refused("agent_stopping", "the agent was shut down"))
            run.over.wait(timeout=2)

    def _script(self, request: RunMovement, run: "_Run") -> ScriptAction:
        """Check a script, and select the sandbox for it."""
        self._policy.verify(request)
        untrusted = self._policy.is_untrusted(request)
        refusal = self._sandbox.refusal(untrusted=untrusted)
        if refusal is not None:
            raise Refused("no_sandbox", refusal)
        sandbox = ScriptSandbox(self._sandbox, untrusted)
        return ScriptAction(request, run.robot, run.add_output, sandbox=sandbox, on_exit=run.robot.release)

    def _execute(self, run: "_Run") -> None:
        try:
            run.execute()
        except BaseException:
            run.end(AckStatus.FAILED, _INTERNAL)
            raise
        finally:
            run.robot.release()
            with self._lock:
                self._run = None
            run.report_end()


class _Activity(Protocol):
    """Work of an action."""

    def run(self) -> dict[str, Any]:
        """Run to the end; returns additional entries of the result."""

    def kill(self) -> None:
        """End it, from any thread; never blocks. May be called twice."""


class _Script:
    """A movement script."""

    def __init__(self, script: ScriptAction, run: "_Run") -> None:
        self._script = script
        self._robot = run.robot

    def kill(self) -> None:
        self._script.kill()

    def run(self) -> dict[str, Any]:
        self._script.run()
        return self._robot.limits()


class _TimedActivity:
    """An activity with the time limit of a movement."""

    def __init__(self, activity: _Activity, movement: RunMovement, run: "_Run") -> None:
        self._activity = activity
        self._timeout_s = movement.timeout_ms / 1000
        self._end = run.end

    def kill(self) -> None:
        self._activity.kill()

    def run(self) -> dict[str, Any]:
        why = Refused("too_long", f"the movement was ended after its {self._timeout_s:g} s")
        timer = threading.Timer(self._timeout_s, self._end, (AckStatus.FAILED, why))
        timer.daemon = True
        timer.start()
        try:
            return self._activity.run()
        finally:
            timer.cancel()


class _Run:
    """One action from start to end."""

    def __init__(self, command: Command, context: DeviceContext, report: Report, sync: Callable[[], None]) -> None:
        self._sync = sync
        self.command = command
        self.over = threading.Event()
        self._started = threading.Event()
        self.robot = RobotApi(context)
        self._context = context
        self._report = report
        self._ending: tuple[AckStatus, Refused] | None = None
        self._result: dict[str, Any] = {}
        self._output = ""
        self._progress: float | None = None
        self._reported_s = 0.0
        self._activity: _Activity

    def reserve(self, activity: _Activity) -> None:
        """Reserve the device for an activity.

        Raises:
            Refused: The device cannot be reserved.
        """
        self._activity = activity
        request = self.command.request
        recovery = isinstance(request, RunBehaviour) and self._context.is_recovery(request.name)
        self.robot.reserve(self.command.epoch, self._on_revoked, recovery=recovery)

    def report_started(self) -> None:
        """Acknowledge the start immediately, while the action's thread starts and syncs the journal."""
        event = self._event(EventKind.ACTION_STARTED, "started")
        self._attempt(lambda: self._report(self.command.id, AckStatus.STARTED, recorded=event))
        self._started.set()

    def execute(self) -> None:
        """Run the activity; returns when it has ended, with or without success."""
        self._attempt(self._sync)  # before any motion: a motion that started must not run again
        self._started.wait()
        if self._ending is None:
            self._attempt(self._run_activity)

    def _run_activity(self) -> None:
        self.add_result(self._activity.run())

    def add_result(self, entries: dict[str, Any]) -> None:
        """Add entries to the result."""
        self._result |= entries

    @property
    def why(self) -> Refused | None:
        """Why the action was ended; ``None``: it was not."""
        return None if self._ending is None else self._ending[1]

    @contextlib.contextmanager
    def reserve_again(self) -> Iterator[None]:
        """Reserve the device after the script has ended.

        Raises:
            Refused: The device cannot be reserved.
        """
        robot = RobotApi(self._context)
        robot.reserve(self.command.epoch, self._on_revoked)
        try:
            yield
        finally:
            robot.release()

    def _attempt(self, step: Callable[[], None]) -> None:
        try:
            step()
        except Refused as refused:
            self.end(AckStatus.FAILED, refused)
        except ScriptFailed as failed:
            self.end(AckStatus.FAILED, Refused("script_failed", str(failed)))
        except Exception:  # noqa: BLE001 (any error ends the action as failed)
            _log.exception("action %s", self.command.id)
            self.end(AckStatus.FAILED, _INTERNAL)

    def end(self, status: AckStatus, why: Refused) -> None:
        """End the action, from any thread; the first reason applies."""
        self._ending = self._ending or (status, why)
        self.robot.release()
        self._activity.kill()

    def report_end(self) -> None:
        """Acknowledge the end."""
        try:
            result = self._context.measured() | self._result
            if self._ending is None:
                event = self._event(EventKind.ACTION_ENDED, "succeeded", status=AckStatus.DONE)
                report = partial(self._report, self.command.id, AckStatus.DONE, progress=1.0)
            else:
                status, why = self._ending
                reason = Reason(code=why.code, message=why.message[:MAX_OUTPUT])
                event = self._event(EventKind.ACTION_ENDED, f"{status}: {why.message}", status=status, code=why.code)
                report = partial(self._report, self.command.id, status, reason=reason)
            report(recorded=event, output=self._output, result=result)
        finally:
            self.over.set()

    def _event(self, kind: EventKind, what: str, **data: str) -> EventRecord:
        """An event of this action for the recording. ``what``: what happened to it."""
        action, caller = self.state(), self.command.caller
        message = f"action {action.kind} {action.name}".rstrip() + f" of {caller} {what}"
        data = {"action": action.id, "task": action.kind, "name": action.name, "caller": caller, **data}
        severity: Severity = "warning" if "code" in data else "info"
        return EventRecord(kind, message, severity, data, wall_ms())

    def state(self) -> ActionState:
        """The action as the device's ``state`` contains it."""
        request = self.command.request
        kind, name = str(type(request).__struct_config__.tag), getattr(request, "name", "")
        return ActionState(id=self.command.id, kind=kind, name=name, progress=self._progress or 0.0)

    def _on_revoked(self, why: Refused) -> None:
        # The controller calls this with its lock held, so this must not call the controller.
        self._ending = self._ending or (AckStatus.FAILED, why)
        self.robot.end()
        self._activity.kill()

    def add_output(self, text: str, progress: float | None) -> None:
        """Add printed output, and the progress if it is given."""
        self._output = (self._output + text)[-MAX_OUTPUT:]
        if progress is not None:
            self._progress = progress
        now_s = time.monotonic()
        if now_s - self._reported_s >= _PROGRESS_PERIOD_S:
            self._reported_s = now_s
            self._report(self.command.id, AckStatus.STARTED, output=self._output, progress=self._progress)
