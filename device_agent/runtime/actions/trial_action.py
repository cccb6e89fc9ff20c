"""Runs one trial of a task: seeded reset, movement script, verdict of the task's monitor."""

import contextlib
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import msgspec

from device_agent.config.release import VERSION
from device_agent.ports.driver import DriverError
from device_agent.ports.skills import TaskMonitor, TaskState
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol import AckStatus, RunTrial, SetControl, TrialCause, TrialReport, Verdict
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.actions.script_action import ScriptAction, ScriptFailed
from device_agent.runtime.errors import Refused

RESET = "reset_objects"
"""Control that resets the objects of a scene to a seed."""
SETTLE_S = 0.5
"""Time after a reset in which the objects come to rest [s]."""
AFTER_S = 1.0
"""Time after the script in which the condition may still be met, in addition to its time at rest [s]."""
_POLL_S = 0.02
_MAX_DETAIL = 500
_UNOBSERVED = frozenset({"link_lost", "agent_stopping", "internal", "too_long"})
"""Ends of an action after which the outcome of the task is unknown."""


class TrialRun(Protocol):
    """The action that runs a trial."""

    @property
    def robot(self) -> RobotApi:
        """Operations of the device, which are reserved for the action until the script has ended."""

    @property
    def why(self) -> Refused | None:
        """Why the action was ended from outside; ``None``: it was not."""

    def reserve_again(self) -> contextlib.AbstractContextManager[None]:
        """Reserve the device after the script, so that nothing else changes the outcome.

        Raises:
            Refused: The device cannot be reserved.
        """

    def end(self, status: AckStatus, why: Refused) -> None:
        """End the action."""

    def add_result(self, entries: dict[str, Any]) -> None:
        """Add entries to the result, which is also reported if the action fails."""


class TrialAction:
    """One trial. The verdict is that of the monitor; the script cannot affect it.

    Args:
        request: The trial.
        script: Runs its movement.
        run: The action.
        context: The device.

    Raises:
        Refused: The device does not have this task.
    """

    def __init__(self, request: RunTrial, script: ScriptAction, *, run: TrialRun, context: DeviceContext) -> None:
        self._monitors = context.task_monitors
        self._task = self._monitors.find(request.name, request.tasks_sha256)
        self._seed = request.seed
        self._script = script
        self._run = run
        self._context = context
        self._ended = threading.Event()
        self._expired = False
        self._start_s = 0.0

    def kill(self) -> None:
        """End the trial, from any thread; never blocks. May be called twice."""
        self._ended.set()
        self._script.kill()

    def run(self) -> dict[str, Any]:
        """Run the trial. Its report is in the result, also after a failure.

        Raises:
            Refused: The trial did not start, or its time limit passed.
            ScriptFailed: The movement failed.
        """
        try:
            monitor = self._monitors.open(self._task)
        except Refused as refused:
            self._report(Verdict.UNKNOWN, TrialCause.NOT_STARTED, refused.message)
            raise
        with contextlib.closing(monitor):
            try:
                self._prepare(monitor)
            except (DriverError, Refused) as error:
                self._report(Verdict.UNKNOWN, TrialCause.NOT_STARTED, str(error))
                raise error if isinstance(error, Refused) else Refused("not_observed", str(error)) from error
            failure = self._run_script(monitor)
            try:
                self._observe_end(monitor)
                self._judge(monitor.state(), failure)
            except DriverError as error:
                self._report(Verdict.UNKNOWN, TrialCause.LOST, str(error))
        if failure is not None:
            raise failure
        return self._run.robot.limits()

    def _prepare(self, monitor: TaskMonitor) -> None:
        """Reset the objects if there is a seed, and let them come to rest."""
        if self._seed is not None:
            controls = self._context.controls
            if controls is None or all(control.name != RESET for control in controls.controls):
                raise Refused("no_objects", "this robot cannot reset objects; start the trial without a seed")
            self._run.robot.skill_runner.set_control(SetControl(control=RESET, value=float(self._seed)), controls)
            self._wait(monitor, SETTLE_S, lambda _: False)
        monitor.restart()
        self._start_s = monitor.state().time_s

    def _run_script(self, monitor: TaskMonitor) -> Refused | ScriptFailed | None:
        """Run the movement until its end or the time limit; returns its error."""
        over = threading.Event()
        watch = partial(self._watch, monitor, over)
        watcher = SupervisedThread(watch, name="trial-watch", part="watch of a trial", device=self._context.name)
        watcher.start()
        try:
            self._script.run()
        except ScriptFailed as failed:
            limit = Refused("time_limit", f"the time limit of the task, {self._task.time_limit_s:g} s, has passed")
            return limit if self._expired else failed
        finally:
            over.set()
            watcher.join()
        return None

    def _watch(self, monitor: TaskMonitor, over: threading.Event) -> None:
        """End the script at the time limit. A measured condition must be read regularly, which this does."""
        with contextlib.suppress(DriverError):  # the state after the script shows it
            while not over.wait(_POLL_S):
                if self._remaining_s(monitor.state()) <= 0:
                    self._expired = True
                    self._script.kill()
                    return

    def _observe_end(self, monitor: TaskMonitor) -> None:
        """Wait for the condition, for a short time and within the time limit. Meanwhile nothing else may move."""
        if self._run.why is not None or self._expired:
            return
        try:
            with self._run.reserve_again():
                self._wait(monitor, self._task.success.rest_s + AFTER_S, self._is_over)
        except Refused as refused:
            self._run.end(AckStatus.FAILED, refused)

    def _wait(self, monitor: TaskMonitor, duration_s: float, is_over: Callable[[TaskState], bool]) -> None:
        """Wait on the clock of the monitor [s], until ``is_over`` or the end of the action."""
        end_s = monitor.state().time_s + duration_s
        while not self._ended.wait(_POLL_S):
            state = monitor.state()
            if is_over(state) or state.time_s >= end_s:
                return

    def _is_over(self, state: TaskState) -> bool:
        return state.met or self._remaining_s(state) <= 0

    def _remaining_s(self, state: TaskState) -> float:
        return self._task.time_limit_s - (state.time_s - self._start_s)

    def _judge(self, state: TaskState, failure: Refused | ScriptFailed | None) -> None:
        duration_s, why = state.time_s - self._start_s, self._run.why
        if why is not None:
            self._report(*_outcome_of(why), why.message, duration_s)
        elif state.met:
            self._report(Verdict.SUCCESS, TrialCause.NONE, "" if failure is None else str(failure), duration_s)
        elif self._remaining_s(state) <= 0:
            self._report(Verdict.FAILED, TrialCause.TIME_LIMIT, state.detail, duration_s)
        elif failure is not None:
            self._report(Verdict.FAILED, TrialCause.MOVEMENT_FAILED, str(failure), duration_s)
        else:
            self._report(Verdict.FAILED, state.failure, state.detail, duration_s)

    def _report(self, verdict: Verdict, cause: TrialCause, detail: str, duration_s: float = 0.0) -> None:
        report = TrialReport(
            verdict=verdict,
            cause=cause,
            detail=detail[:_MAX_DETAIL],
            duration_s=round(duration_s, 3),
            simulated=self._monitors.simulated,
            software=VERSION,
            type_version=self._context.robot_type.version,
        )
        self._run.add_result({"trial": msgspec.to_builtins(report)})


def _outcome_of(why: Refused) -> tuple[Verdict, TrialCause]:
    """Verdict and cause of a trial that was ended from outside."""
    if why.code in _UNOBSERVED:
        return Verdict.UNKNOWN, TrialCause.LOST
    return Verdict.FAILED, TrialCause.MOVEMENT_FAILED if why.code == "fault" else TrialCause.STOPPED
