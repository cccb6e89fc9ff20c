"""Control loop: early periods, Stop and telemetry rate."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from device_agent.ports.driver import Observation
from device_agent.protocol import (
    JointTarget,
    JointTelemetry,
    Mode,
    Setpoint,
    Stop,
    StopDevice,
    StopLatch,
    codec,
    topics,
)
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.control_loop import ControlLoop
from device_agent.runtime.control.controller import Controller
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness
from tests.harness.network.brokers import SILENCE_S, wait_until

LONG_MS = 600_000
"""No test waits for a period of this length: it is longer than any patience."""


class LoopFixture:
    """A toy arm whose control loop runs, and its operator."""

    def __init__(self, driver: FakeDriver | None = None, *, period_ms: int = LONG_MS) -> None:
        kind = robot_type(period_ms=period_ms)
        self.driver = driver or FakeDriver()
        self.controller = Controller(kind, LeaseGate())
        self.published: list[JointTelemetry] = []
        self.loop = ControlLoop(
            kind,
            self.driver,
            self.controller,
            name="arm",
            publish=self.published.append,
            check_interlocks=lambda _now_s: None,
        )
        self._sequence = 0

    def start(self) -> None:
        self.loop.start()
        wait_until(lambda: len(self.published) == 1, "the first period")
        self.controller.grant(epoch=1, holder="ann", lease_s=1000, now_s=time.monotonic())

    def send_setpoint(self, elbow_rad: float) -> None:
        self._sequence += 1
        target = JointTarget(position_rad={"elbow": elbow_rad})
        setpoint = Setpoint(epoch=1, sequence=self._sequence, echo_tick_ms=5, sent_ms=0.0, target=target)
        self.controller.accept_setpoint(setpoint, now_s=time.monotonic(), tick_ms=10)
        self.loop.wake()


@pytest.fixture
def setup() -> Iterator[LoopFixture]:
    setup = LoopFixture()
    setup.start()
    yield setup
    setup.loop.stop()


def test_a_device_at_rest_follows_a_setpoint_at_once(setup: LoopFixture) -> None:
    setup.send_setpoint(0.5)
    wait_until(lambda: setup.driver.position[1] == pytest.approx(0.5), "the setpoint at the driver")
    wait_until(lambda: setup.published[-1].setpoint_sequence == 1, "telemetry of it")


def test_a_flood_of_setpoints_adds_one_period(setup: LoopFixture) -> None:
    setup.send_setpoint(0.5)
    wait_until(lambda: setup.driver.position[1] == pytest.approx(0.5), "the setpoint at the driver")
    setup.send_setpoint(0.7)
    time.sleep(SILENCE_S)
    assert setup.driver.position[1] == pytest.approx(0.5)


class InlineDriver(FakeDriver):
    """Its loop's thread is not needed: ``threads`` are those that have commanded it."""

    prompt = True

    def __init__(self) -> None:
        super().__init__()
        self.threads: list[str] = []

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        self.threads.append(threading.current_thread().name)
        return super().send(position_rad)


def test_an_inline_driver_is_commanded_by_the_callers_thread() -> None:
    setup = LoopFixture(InlineDriver())
    setup.start()
    try:
        setup.send_setpoint(0.5)
        assert setup.driver.position[1] == pytest.approx(0.5)
        assert setup.published[-1].setpoint_sequence == 1
        setup.send_setpoint(0.7)  # the second waits for its period, which here takes ten minutes
        assert setup.driver.position[1] == pytest.approx(0.5)
        assert isinstance(setup.driver, InlineDriver)
        assert setup.driver.threads[1:] == [threading.current_thread().name]
    finally:
        setup.loop.stop()
    setup.loop._out_of_turn = False
    setup.send_setpoint(0.9)
    assert len(setup.driver.threads) == 2, "who has stopped commands nothing more"


def test_a_full_period_follows_an_early_one() -> None:
    driver = InlineDriver()
    setup = LoopFixture(driver, period_ms=300)
    setup.start()
    try:
        before = len(driver.threads)
        wait_until(lambda: len(driver.threads) > before, "a period")
        setup.loop._out_of_turn = False
        setup.send_setpoint(0.5)
        asked_s, commanded = time.monotonic(), len(driver.threads)
        wait_until(lambda: len(driver.threads) > commanded, "the next period")
        assert time.monotonic() - asked_s >= 0.29
    finally:
        setup.loop.stop()


def test_a_blocked_period_does_not_prevent_stop() -> None:
    setup = LoopFixture()
    setup.start()
    with setup.loop._period_lock:
        setup.loop.stop()
    assert setup.loop._stopping.is_set()


def test_concurrent_wakes_run_one_period() -> None:
    """The other finds out when it has the turn, not before; so does the loop's own thread."""
    driver = InlineDriver()
    setup = LoopFixture(driver)
    setup.start()
    real = setup.loop._period_lock

    class Turn:
        """A lock after whose acquisition another thread has just run a period."""

        def acquire(self, **how: Any) -> bool:
            taken = real.acquire(**how)
            setup.loop._out_of_turn = True
            return taken

        def release(self) -> None:
            real.release()

        def __enter__(self) -> None:
            self.acquire()

        def __exit__(self, *_: object) -> None:
            self.release()

    try:
        wait_until(lambda: setup.loop._next_s > time.monotonic() + LONG_MS / 2000, "the first period")
        setup.loop._period_lock = Turn()  # type: ignore[assignment]
        commanded = len(driver.threads)
        setup.send_setpoint(0.5)
        time.sleep(SILENCE_S)
        assert len(driver.threads) == commanded
    finally:
        setup.loop._period_lock = real
        setup.loop.stop()


def test_an_error_in_an_early_period_is_a_fault_until_the_driver_responds() -> None:
    setup = LoopFixture(InlineDriver(), period_ms=8)
    setup.start()
    try:
        with setup.loop._period_lock:  # its loop's thread waits meanwhile
            setup.driver.broken = True
            setup.controller.update(time.monotonic())
        wait_until(lambda: setup.controller.fault is not None, "the fault")
        setup.driver.broken = False
        wait_until(lambda: setup.controller.fault is None, "the driver's return")
    finally:
        setup.loop.stop()
    setup = LoopFixture(InlineDriver())
    setup.start()
    try:
        setup.driver.refuses = True
        setup.send_setpoint(0.5)
        wait_until(lambda: setup.controller.fault == "no", "the fault")
    finally:
        setup.loop.stop()


def plainly(harness: DeviceHarness) -> None:
    harness.receive(topics.STOP, codec.encode(Stop(id="s", caller="ann", reason="")))


def signed(harness: DeviceHarness) -> None:
    harness.command(StopDevice(reason=""))


@pytest.mark.parametrize("stop", [plainly, signed])
@pytest.mark.parametrize("driver", [FakeDriver, InlineDriver])
def test_a_stop_at_rest_does_not_wait_for_a_period(
    tmp_path: Path, driver: type[FakeDriver], stop: Callable[[DeviceHarness], object]
) -> None:
    harness = DeviceHarness(tmp_path, driver=driver(), kind=robot_type(period_ms=LONG_MS))
    harness.device.start()
    try:
        loop = harness.device._loop
        assert isinstance(loop, ControlLoop)
        wait_until(lambda: loop._next_s > time.monotonic() + LONG_MS / 2000, "the first period")
        stop(harness)
        wait_until(lambda: harness.device._controller.mode is Mode.STOPPED, "the period that obeys")
    finally:
        harness.stop()


def test_in_motion_periods_keep_their_length() -> None:
    setup = LoopFixture(InlineDriver(), period_ms=8)
    setup.controller.start_at((0.0, 0.0))
    now_s = time.monotonic()
    setup.controller.grant(epoch=1, holder="ann", lease_s=1000, now_s=now_s)
    setup.send_setpoint(0.5)
    assert setup.loop._wait()
    setup.controller.update(now_s)
    assert setup.controller.moving
    setup.send_setpoint(0.6)
    assert not setup.loop._wait()
    assert setup.driver.position[1] == 0.0, "no period has been run"


def moving(period_ms: int, periods: int = 20) -> LoopFixture:
    """A setup whose arm moves and whose loop's thread is held back, as between two periods."""
    setup = LoopFixture(InlineDriver(), period_ms=period_ms)
    setup.controller.start_at((0.0, 0.0))
    setup.loop._thread = threading.current_thread()
    now_s = time.monotonic()
    setup.controller.grant(epoch=1, holder="ann", lease_s=1000, now_s=now_s)
    setup.loop._out_of_turn = True
    setup.send_setpoint(2.5)
    for _ in range(periods):
        setup.loop._run_period(early=False)
    assert setup.controller.mode is Mode.STREAMING
    assert setup.controller.moving
    return setup


def test_a_stop_in_motion_brakes_at_once_for_the_elapsed_time() -> None:
    setup = moving(period_ms=4)
    assert isinstance(setup.driver, InlineDriver)
    before_rad, speed_rad_s = setup.driver.position[1], setup.controller._state.motion.velocity_rad_s[1]
    commanded = len(setup.driver.threads)
    setup.loop._next_s = time.monotonic() + 0.004 - 0.001  # a quarter of the period has passed, or more
    setup.controller.stop(StopLatch(caller="bob", reason="", at_ms=1))
    setup.loop.wake()
    assert setup.controller.mode is Mode.STOPPED
    assert len(setup.driver.threads) == commanded + 1
    assert 0 < setup.driver.position[1] - before_rad <= speed_rad_s * 0.004 + 1e-9
    assert setup.controller.moving, "it brakes, it does not jump"
    assert setup.loop._next_s > time.monotonic() - 1
    setup.loop.wake()
    assert len(setup.driver.threads) == commanded + 1, "only once: then periods keep their length again"


def test_a_stop_after_an_early_period_does_not_wait() -> None:
    setup = moving(period_ms=4)
    setup.loop._out_of_turn = True
    setup.controller.stop(StopLatch(caller="bob", reason="", at_ms=1))
    setup.loop.wake()
    assert setup.controller.mode is Mode.STOPPED


def test_the_elapsed_time_is_bounded() -> None:
    setup = moving(period_ms=4)
    setup.loop._next_s = 10.0
    assert [setup.loop._passed_s(now_s) for now_s in (9.0, 9.996, 9.998, 10.0, 11.0)] == pytest.approx(
        [0.0001, 0.0001, 0.002, 0.004, 0.004]
    )


def test_a_stop_waits_for_the_running_period() -> None:
    setup = moving(period_ms=100, periods=3)
    setup.controller.stop(StopLatch(caller="bob", reason="", at_ms=1))
    setup.loop._period_lock.acquire()
    threading.Timer(0.05, setup.loop._period_lock.release).start()
    setup.loop.wake()
    assert setup.controller.mode is Mode.STOPPED


def test_telemetry_follows_setpoints_within_its_rate_limit() -> None:
    setup = LoopFixture()
    setup.controller.start_at((0.0, 0.0))
    seen, tick = Observation((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), ()), setup.controller.update(0.0)

    def told(now_s: float, sequence: int) -> bool:
        before = len(setup.published)
        setup.loop._publish_telemetry(now_s, seen, replace(tick, setpoint_sequence=sequence), (0.0, 0.0))
        return len(setup.published) > before

    asked = ((0.0, 0), (0.03, 0), (0.03, 1), (0.04, 2), (0.045, 3), (0.0501, 3))
    assert [told(now_s, sequence) for now_s, sequence in asked] == [True, False, True, True, False, True]


def test_telemetry_is_in_step_with_setpoints_or_at_33_hz() -> None:
    setup = LoopFixture()
    setup.controller.start_at((0.0, 0.0))
    seen = Observation((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), ())
    tick = replace(setup.controller.update(0.0), mode=Mode.STREAMING)
    for period in range(1001):
        now_s = period / 1000
        setup.loop._publish_telemetry(now_s, seen, replace(tick, setpoint_sequence=period // 25), (0.0, 0.0))
    assert [each.setpoint_sequence for each in setup.published] == list(range(41))
    setup.published.clear()
    for period in range(1001, 2002):
        setup.loop._publish_telemetry(period / 1000, seen, replace(tick, setpoint_sequence=40), (0.0, 0.0))
    assert 32 <= len(setup.published) <= 34
