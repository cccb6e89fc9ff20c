"""Supervision: a thread that ends or hangs is noticed within a second of the supervisor's time, and handled."""

import threading
from collections.abc import Iterator

import pytest

from device_agent.ports import threads
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.runtime import supervision
from device_agent.runtime.supervision import CHECK_PERIOD_S, HANGING_S, MAX_RESTARTS, REPORT_S, Failure, Supervisor


class Listener:
    """Records the failures that the supervisor reports."""

    def __init__(self, name: str = "arm") -> None:
        self.name = name
        self.failed: list[Failure] = []
        self.recovered: list[Failure] = []

    def part_failed(self, failure: Failure) -> None:
        self.failed.append(failure)

    def part_recovered(self, failure: Failure) -> None:
        self.recovered.append(failure)


class Loop:
    """A supervised thread that ends when the test says so. The test reports its progress, unless it is to hang."""

    def __init__(self, recovery: Recovery, device: str = "arm") -> None:
        self.stopping, self._dying = threading.Event(), threading.Event()
        self.hangs = False
        self.thread = SupervisedThread(
            self._run, name="loop", part="test loop", stopping=self.stopping, recovery=recovery, device=device,
            within_s=0.5,
        )  # fmt: skip
        self.thread.start()

    def _run(self) -> None:
        self._dying.wait()
        if not self.stopping.is_set():
            raise RuntimeError("a defect")

    def die(self) -> None:
        self._dying.set()
        self.thread.join(10)
        self._dying.clear()

    def close(self) -> None:
        self.stopping.set()
        self.die()


class Fixture:
    """A supervisor with a virtual clock that watches the threads of one test."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.loops: list[Loop] = []
        self.supervisor = Supervisor(clock_s=lambda: self.now_s, watched=self._watched)
        self.listener, self.other = Listener(), Listener("leg")
        self.supervisor.add(self.listener)
        self.supervisor.add(self.other)

    def _watched(self) -> list[SupervisedThread]:
        own = {loop.thread for loop in self.loops}
        return [thread for thread in threads.watched() if thread in own]

    def loop(self, recovery: Recovery, device: str = "arm") -> Loop:
        self.loops.append(Loop(recovery, device))
        self.check(0.0)
        return self.loops[-1]

    def check(self, for_s: float) -> str:
        """Check in every period for this time; returns why the process must end, if it must."""
        until_s = self.now_s + for_s
        while True:
            for loop in self.loops:
                if loop.thread.is_alive() and not loop.hangs:
                    loop.thread.beat()
            if reason := self.supervisor.check():
                return reason
            if self.now_s >= until_s:
                return ""
            self.now_s += CHECK_PERIOD_S


@pytest.fixture
def fixture() -> Iterator[Fixture]:
    fixture = Fixture()
    yield fixture
    for loop in fixture.loops:
        loop.close()


def test_a_thread_that_ends_is_reported_at_the_next_check_and_started_again(fixture: Fixture) -> None:
    loop = fixture.loop(Recovery.RESTART)
    loop.die()
    assert fixture.check(0.0) == ""
    assert [failure.message for failure in fixture.listener.failed] == [
        "the test loop has ended (internal error: RuntimeError('a defect')); it is started again"
    ]
    assert fixture.other.failed == []
    assert fixture.check(1.0) == ""
    assert loop.thread.is_alive()
    assert fixture.listener.recovered == fixture.listener.failed


def test_a_thread_that_returns_unexpectedly_is_reported(fixture: Fixture) -> None:
    loop = fixture.loop(Recovery.RESTART)
    loop.thread._target = lambda: None
    loop.die()
    fixture.check(1.0)
    loop.thread.join(10)
    fixture.check(0.0)
    assert "it returned" in fixture.listener.failed[-1].message


def test_a_thread_of_no_device_concerns_every_device(fixture: Fixture) -> None:
    fixture.loop(Recovery.RESTART, device="").die()
    fixture.check(1.0)
    assert len(fixture.listener.failed) == len(fixture.other.failed) == 1
    assert len(fixture.listener.recovered) == len(fixture.other.recovered) == 1


@pytest.mark.parametrize("recovery", [Recovery.RESTART, Recovery.RESTART_OR_EXIT])
def test_a_thread_that_fails_repeatedly_is_not_started_again(fixture: Fixture, recovery: Recovery) -> None:
    loop = fixture.loop(recovery)
    for _ in range(MAX_RESTARTS + 1):
        loop.die()
        fixture.check(0.0)
    assert not loop.thread.is_alive()
    assert "repeatedly" in fixture.listener.failed[-1].message
    ends = recovery is Recovery.RESTART_OR_EXIT
    assert bool(fixture.check(REPORT_S + 1)) is ends
    assert len(fixture.listener.failed) == MAX_RESTARTS + 1
    assert fixture.supervisor.healthy is not ends


def test_rare_failures_are_always_followed_by_a_restart(fixture: Fixture) -> None:
    loop = fixture.loop(Recovery.RESTART_OR_EXIT)
    for _ in range(3 * MAX_RESTARTS):
        loop.die()
        assert fixture.check(supervision.RESTART_WINDOW_S / 2) == ""
        assert loop.thread.is_alive()


def test_the_end_of_an_essential_thread_ends_the_process_after_the_report(fixture: Fixture) -> None:
    loop = fixture.loop(Recovery.EXIT)
    loop.die()
    assert fixture.check(0.0) == ""
    assert fixture.supervisor.healthy is False
    died_s = fixture.now_s
    assert "the agent restarts" in fixture.check(10.0)
    assert fixture.now_s - died_s == pytest.approx(REPORT_S, abs=1.5 * CHECK_PERIOD_S)


@pytest.mark.parametrize("recovery", [Recovery.RESTART, Recovery.EXIT])
def test_a_thread_that_hangs_is_reported_within_a_second_and_again_after_it_responded(
    fixture: Fixture, recovery: Recovery
) -> None:
    loop = fixture.loop(recovery)
    for times in (1, 2):
        loop.hangs = True
        fixture.check(1.0 - CHECK_PERIOD_S)
        assert len(fixture.listener.failed) == times
        assert "does not respond" in fixture.listener.failed[-1].message
        assert fixture.supervisor.healthy is (recovery is Recovery.RESTART)
        loop.hangs = False
        assert fixture.check(1.0) == ""
        assert len(fixture.listener.recovered) == times
        assert fixture.supervisor.healthy


@pytest.mark.parametrize("recovery", [Recovery.RESTART, Recovery.EXIT, Recovery.RESTART_OR_EXIT])
def test_only_an_essential_thread_that_keeps_hanging_ends_the_process(fixture: Fixture, recovery: Recovery) -> None:
    fixture.loop(recovery).hangs = True
    reason = fixture.check(HANGING_S + 2.0)
    assert bool(reason) is (recovery is not Recovery.RESTART)


def test_a_longer_wait_that_was_announced_is_no_hang(fixture: Fixture) -> None:
    loop = fixture.loop(Recovery.EXIT)
    loop.hangs = True
    loop.thread.beat(within_s=5.0)
    fixture.check(4.0)
    assert fixture.listener.failed == []
    fixture.check(2.0)
    assert len(fixture.listener.failed) == 1


def test_a_suspended_process_is_not_taken_for_a_hanging_thread(fixture: Fixture) -> None:
    fixture.loop(Recovery.EXIT).hangs = True
    fixture.now_s += 1000.0
    fixture.check(0.0)
    assert fixture.listener.failed == []


def test_a_thread_that_was_asked_to_end_is_not_reported(fixture: Fixture) -> None:
    loop = fixture.loop(Recovery.EXIT)
    loop.hangs = True
    loop.stopping.set()
    fixture.check(2.0)
    loop.close()
    fixture.check(0.0)
    assert fixture.listener.failed == []
    assert loop.thread not in threads.watched()


def test_the_failure_of_a_thread_that_is_then_asked_to_end_is_over(fixture: Fixture) -> None:
    loop = fixture.loop(Recovery.RESTART)
    loop.hangs = True
    fixture.check(1.0)
    loop.close()
    fixture.check(0.0)
    assert fixture.listener.recovered == fixture.listener.failed != []


def test_a_task_may_return_but_its_error_is_reported_once() -> None:
    def fail() -> None:
        raise SystemExit

    tasks = [SupervisedThread(target, name="task", part="task") for target in (lambda: None, fail)]
    supervisor, listener = Supervisor(watched=lambda: [each for each in threads.watched() if each in tasks]), Listener()
    supervisor.add(listener)
    for task in tasks:
        assert not task.failed
        task.join(0)
        task.start()
        task.join(10)
    assert threads.watched().count(tasks[0]) == 0
    for _ in range(3):
        assert supervisor.check() == ""
    assert [failure.message for failure in listener.failed] == [
        "the task has ended (internal error: SystemExit()); the device holds"
    ]
    assert not listener.failed[0].lasts
    assert tasks[1] not in threads.watched()


def test_an_uncaught_error_of_any_other_thread_is_reported() -> None:
    supervisor, listener = Supervisor(watched=list), Listener()
    supervisor.add(listener)
    supervisor.start()
    try:
        timer = threading.Timer(0.0, lambda: 1 / 0)
        timer.name = "limit"
        timer.start()
        timer.join()
        threading.excepthook(threading.ExceptHookArgs((RuntimeError, RuntimeError("x"), None, None)))
    finally:
        supervisor.stop()
    supervisor.check()
    assert ["division" in failure.message for failure in listener.failed] == [True, False]
    assert listener.failed[0].part == "thread limit"
    assert listener.recovered == []


def test_the_devices_notice_a_supervisor_that_does_not_check() -> None:
    now_s = 0.0
    supervisor = Supervisor(clock_s=lambda: now_s, watched=list)
    faults = supervision.PartFaults(supervisor, clock_s=lambda: now_s)

    def present(for_s: float, *, checks: bool) -> list[str]:
        nonlocal now_s
        until_s = now_s + for_s
        while now_s < until_s:
            now_s += CHECK_PERIOD_S
            if checks:
                supervisor.check()
            codes = [fault.code for fault in faults.present()]
        return codes

    assert present(10.0, checks=False) == []  # not started
    assert present(10.0, checks=True) == []
    now_s += 100.0  # suspended
    assert present(supervision.SILENT_S - 0.5, checks=False) == []
    assert present(1.0, checks=False) == ["agent.supervisor"]
    assert present(1.0, checks=True) == []


def test_a_short_fault_is_returned_at_least_once() -> None:
    faults = supervision.PartFaults(Supervisor(watched=list))
    failure = Failure("Camera thread", "arm", "it has ended")
    faults.add(failure)
    faults.remove(failure)
    assert [(fault.code, fault.message) for fault in faults.present()] == [("agent.camera-thread", "it has ended")]
    assert faults.present() == ()
    faults.add(failure)
    faults.remove(failure)
    faults.add(failure)
    assert len(faults.present()) == len(faults.present()) == 1
