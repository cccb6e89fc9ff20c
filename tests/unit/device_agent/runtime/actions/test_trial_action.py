"""Trials of tasks: only the verdict of the monitor counts, not what the script or the operator claim."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from device_agent.config.release import VERSION
from device_agent.protocol import AckStatus, CancelAction, RunMovement, RunTrial, State, TrialCause, Verdict, topics
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.actions.task_monitors import TaskMonitors
from device_agent.runtime.actions.trial_action import TrialAction
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.actions.robot_api_fixture import device_context
from tests.unit.device_agent.runtime.actions.trial_fixture import MANIFEST, TrialRobot, report_of, trial
from tests.unit.device_agent.runtime.conftest import MakeDevice

WAITING = "wait(600)"


@pytest.fixture
def robot() -> TrialRobot:
    return TrialRobot()


@pytest.fixture
def harness(make_device: MakeDevice, robot: TrialRobot) -> DeviceHarness:
    return make_device(driver=robot, tasks=MANIFEST)


def test_a_met_condition_is_a_success(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.monitor.is_met = lambda time_s: time_s > 1.5
    ack = harness.done(trial(harness), epoch=1)
    report = report_of(ack)
    assert (report.verdict, report.cause, report.detail) == (Verdict.SUCCESS, TrialCause.NONE, "")
    assert (report.simulated, report.software, report.type_version) == (True, VERSION, 1)
    assert report.duration_s > 1.5
    assert robot.seeds == [7.0]
    assert ack.output == "moved\n"
    assert "position_rad" in ack.result
    assert (robot.monitor.restarts, robot.monitor.closed.is_set()) == (1, True)


def test_a_condition_that_is_not_met_is_a_failure_of_a_movement_that_ended(
    harness: DeviceHarness, robot: TrialRobot
) -> None:
    report = report_of(harness.done(trial(harness), epoch=1))
    assert (report.verdict, report.cause, report.detail) == (Verdict.FAILED, TrialCause.INCOMPLETE, "it fell")
    assert robot.monitor.closed.is_set()


def test_a_script_cannot_claim_success(harness: DeviceHarness) -> None:
    source = "print({'trial': {'verdict': 'success'}})\nprogress(1.0)"
    assert report_of(harness.done(trial(harness, source), epoch=1)).verdict is Verdict.FAILED


@pytest.mark.parametrize(
    ("met", "verdict", "cause"),
    [(True, Verdict.SUCCESS, TrialCause.NONE), (False, Verdict.FAILED, TrialCause.MOVEMENT_FAILED)],
)
def test_an_error_of_the_script_does_not_decide(
    harness: DeviceHarness, robot: TrialRobot, *, met: bool, verdict: Verdict, cause: TrialCause
) -> None:
    robot.monitor.is_met = lambda _: met
    ack = harness.end(harness.command(trial(harness, "raise ValueError('no cube')"), epoch=1))
    assert ack.reason is not None
    assert (ack.status, ack.reason.code) == (AckStatus.FAILED, "script_failed")
    report = report_of(ack)
    assert (report.verdict, report.cause) == (verdict, cause)
    assert "no cube" in report.detail


def test_the_time_limit_on_the_clock_of_the_monitor_ends_the_script(harness: DeviceHarness, robot: TrialRobot) -> None:
    ack = harness.end(harness.command(trial(harness, WAITING), epoch=1))
    assert ack.reason is not None
    assert (ack.status, ack.reason.code) == (AckStatus.FAILED, "time_limit")
    report = report_of(ack)
    assert (report.verdict, report.cause) == (Verdict.FAILED, TrialCause.TIME_LIMIT)
    assert 60 <= report.duration_s < 61
    assert robot.monitor.closed.is_set()


def test_stop_ends_a_trial_as_stopped(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.monitor.step_s = 0.0
    running = harness.command(trial(harness, WAITING, seed=None), epoch=1)
    assert robot.monitor.looked.wait(60)
    harness.receive_stop()
    ack = harness.end(running)
    assert ack.reason is not None
    assert ack.reason.code == "stopped"
    report = report_of(ack)
    assert (report.verdict, report.cause) == (Verdict.FAILED, TrialCause.STOPPED)
    assert "bob" in report.detail


def test_stop_during_the_reset_ends_a_trial(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.monitor.step_s = 0.0
    running = harness.command(trial(harness, WAITING), epoch=1)
    assert eventually(lambda: robot.seeds)
    harness.receive_stop()
    assert report_of(harness.end(running)).cause is TrialCause.STOPPED


def test_a_cancelled_trial_is_stopped(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.monitor.step_s = 0.0
    running = harness.command(trial(harness, WAITING, seed=None), epoch=1)
    assert robot.monitor.looked.wait(60)
    harness.command(CancelAction(action=running))
    ack = harness.end(running)
    assert ack.status is AckStatus.CANCELLED
    assert report_of(ack).cause is TrialCause.STOPPED


def lose_link(harness: DeviceHarness, robot: TrialRobot) -> None:
    del robot
    harness.device.link_changed(False)


def break_robot(harness: DeviceHarness, robot: TrialRobot) -> None:
    del harness
    robot.broken = True


@pytest.mark.parametrize(
    ("event", "verdict", "cause"),
    [(lose_link, Verdict.UNKNOWN, TrialCause.LOST), (break_robot, Verdict.FAILED, TrialCause.MOVEMENT_FAILED)],
)
def test_a_trial_that_the_machine_ends(
    harness: DeviceHarness,
    robot: TrialRobot,
    event: Callable[[DeviceHarness, TrialRobot], None],
    verdict: Verdict,
    cause: TrialCause,
) -> None:
    robot.monitor.step_s = 0.0
    robot.monitor.is_met = lambda _: True  # a condition that is met now does not make it a success
    running = harness.command(trial(harness, WAITING, seed=None), epoch=1)
    assert robot.monitor.looked.wait(60)
    event(harness, robot)
    report = report_of(harness.end(running))
    assert (report.verdict, report.cause) == (verdict, cause)


def test_a_trial_whose_monitor_stands_still_ends_with_the_action(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.monitor.step_s = 0.0
    request = trial(harness, WAITING, seed=None)
    short = msgspec.structs.replace(request.movement, timeout_ms=300)
    ack = harness.end(harness.command(msgspec.structs.replace(request, movement=short), epoch=1))
    assert ack.reason is not None
    assert ack.reason.code == "too_long"
    assert report_of(ack).verdict is Verdict.UNKNOWN


@pytest.mark.parametrize("source", ["print('moved')", WAITING])
def test_a_monitor_that_fails_makes_the_outcome_unknown(harness: DeviceHarness, robot: TrialRobot, source: str) -> None:
    robot.monitor.broken = 3
    request = trial(harness, source, seed=None)
    short = msgspec.structs.replace(request.movement, timeout_ms=2_000)
    ack = harness.end(harness.command(msgspec.structs.replace(request, movement=short), epoch=1))
    report = report_of(ack)
    assert (report.verdict, report.cause) == (Verdict.UNKNOWN, TrialCause.LOST)
    assert "the simulation has stopped" in report.detail


def test_a_trial_does_not_start_without_the_reset(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.near = True
    ack = harness.end(harness.command(trial(harness), epoch=1))
    assert ack.reason is not None
    assert ack.reason.code == "skill_failed"
    report = report_of(ack)
    assert (report.verdict, report.cause) == (Verdict.UNKNOWN, TrialCause.NOT_STARTED)
    assert report.detail == "the gripper is near the cube"
    assert ack.output == ""
    assert robot.monitor.closed.is_set()


def test_a_trial_does_not_start_without_a_monitor(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.in_room = True
    ack = harness.end(harness.command(trial(harness), epoch=1))
    assert ack.reason is not None
    assert ack.reason.code == "not_observed"
    assert report_of(ack).cause is TrialCause.NOT_STARTED
    robot.in_room = False
    robot.monitor.broken = 1
    ack = harness.end(harness.command(trial(harness), epoch=2))
    assert ack.reason is not None
    assert (ack.reason.code, ack.reason.message) == ("not_observed", "the simulation has stopped")


def test_a_robot_without_a_reset_rejects_a_seed(make_device: MakeDevice, robot: TrialRobot) -> None:
    robot.controls = ()
    harness = make_device(driver=robot, tasks=MANIFEST)
    assert harness.failed(trial(harness), epoch=1).code == "no_objects"


def test_a_real_robot_rejects_a_task_of_a_simulation(make_device: MakeDevice) -> None:
    harness = make_device(driver=FakeDriver(), tasks=MANIFEST)
    reason = harness.failed(trial(harness, seed=None), epoch=1)
    assert (reason.code, "not simulated" in reason.message) == ("not_simulated", True)
    assert harness.failed(trial(harness), epoch=2).code == "not_simulated"


@pytest.mark.parametrize(
    ("changes", "code"), [({"name": "dance"}, "unknown_task"), ({"sha256": "0" * 64}, "tasks_differ")]
)
def test_an_unknown_task_is_rejected_before_the_start(
    harness: DeviceHarness, changes: dict[str, str], code: str
) -> None:
    command = harness.command(trial(harness, **changes), epoch=1)  # type: ignore[arg-type]
    assert harness.end_code(command) == code
    assert all(ack.status is not AckStatus.STARTED for ack in harness.acks(command))
    assert "trial" not in harness.end(command).result


def test_a_robot_without_tasks_rejects_a_trial(make_device: MakeDevice, robot: TrialRobot) -> None:
    harness = make_device(driver=robot)
    assert harness.failed(trial(harness), epoch=1).code == "no_tasks"


def test_the_state_names_the_task(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.monitor.step_s = 0.0
    running = harness.running(trial(harness, WAITING, seed=None), epoch=1)
    states = eventually(lambda: [s for s in harness.published(topics.STATE, State) if s.action is not None])
    assert (states[-1].action.kind, states[-1].action.name) == ("run_trial", "cube_in_tray")
    harness.command(CancelAction(action=running))
    harness.end(running)


def test_an_older_version_of_the_movement_is_rejected(harness: DeviceHarness, robot: TrialRobot) -> None:
    robot.monitor.is_met = lambda _: True
    newer = trial(harness)
    harness.done(msgspec.structs.replace(newer, movement=harness.script("print(2)", version=2)), epoch=1)
    assert harness.failed(newer, epoch=2).code == "rolled_back"


def test_nothing_else_moves_the_robot_while_the_condition_is_observed(
    harness: DeviceHarness, robot: TrialRobot
) -> None:
    outcomes: list[str] = []

    def try_to_move(time_s: float) -> bool:
        if threading.current_thread().name == "trial-watch":  # it may look between the script's end and the observation
            return False
        controller = harness.device._controller
        try:
            controller.end_reservation(controller.reserve(epoch=1, on_revoked=lambda _: None))
            outcomes.append("reserved")
        except Refused as refused:
            outcomes.append(refused.code)
        return time_s > 1.0

    robot.monitor.is_met = try_to_move
    harness.done(trial(harness, "pass", seed=None), epoch=1)
    start, *observation, verdict = outcomes
    assert (start, set(observation), verdict) == ("busy", {"busy"}, "reserved")


class FakeScript:
    """A script that runs ``moves``."""

    def __init__(self, moves: Callable[[], None]) -> None:
        self._moves = moves

    def run(self) -> None:
        self._moves()

    def kill(self) -> None:
        """It has ended."""


class FakeRun:
    """An action whose device can be reserved again unless ``refusal`` is set."""

    def __init__(self, robot: RobotApi) -> None:
        self.robot = robot
        self.why: Refused | None = None
        self.refusal: Refused | None = None
        self.result: dict[str, Any] = {}

    @contextlib.contextmanager
    def reserve_again(self) -> Iterator[None]:
        if self.refusal is not None:
            raise self.refusal
        yield

    def end(self, status: AckStatus, why: Refused) -> None:
        assert status is AckStatus.FAILED
        self.why = why

    def add_result(self, entries: dict[str, Any]) -> None:
        self.result |= entries


class Bench:
    """One trial without sandbox and control loop."""

    def __init__(self) -> None:
        self.driver = TrialRobot()
        self.monitor = self.driver.monitor
        self.monitor.step_s = 0.0
        monitors = TaskMonitors(MANIFEST, self.driver)
        self.context = replace(device_context(robot_type()), task_monitors=monitors)
        self.action_run = FakeRun(RobotApi(self.context))

    def trial(self, moves: Callable[[], None]) -> TrialAction:
        movement = RunMovement(robot_type="test", name="dance", version=1, sha256="0" * 64, source="")
        request = RunTrial(name="cube_in_tray", tasks_sha256=MANIFEST.sha256, movement=movement)
        script: Any = FakeScript(moves)
        return TrialAction(request, script, run=self.action_run, context=self.context)

    @property
    def outcome(self) -> tuple[str, str]:
        report = self.action_run.result["trial"]
        return report["verdict"], report["cause"]


def test_the_time_limit_also_ends_the_wait_after_the_script() -> None:
    bench = Bench()

    def moves() -> None:
        bench.monitor.step_s = 59.5

    assert bench.trial(moves).run() == {}
    assert bench.outcome == ("failed", "time_limit")


def test_stop_while_the_condition_is_observed_ends_the_trial() -> None:
    bench = Bench()

    def stop(_: float) -> bool:
        if moved.is_set():
            bench.action_run.why = Refused("stopped", "stopped by bob")
            trial.kill()
        return False

    moved = threading.Event()
    bench.monitor.is_met = stop
    trial = bench.trial(moved.set)
    trial.run()
    assert bench.outcome == ("failed", "stopped")


def test_stop_between_the_script_and_the_observation_ends_the_trial() -> None:
    bench = Bench()
    bench.action_run.refusal = Refused("stopped", "stopped by bob")
    bench.trial(lambda: None).run()
    assert bench.action_run.why is bench.action_run.refusal
    assert bench.outcome == ("failed", "stopped")


def test_a_script_that_ends_after_stop_is_not_observed() -> None:
    bench = Bench()
    bench.monitor.is_met = lambda _: True

    def moves() -> None:
        bench.action_run.why = Refused("agent_stopping", "the agent was shut down")

    bench.trial(moves).run()
    assert bench.outcome == ("unknown", "lost")
