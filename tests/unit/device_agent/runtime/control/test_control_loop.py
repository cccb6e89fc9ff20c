"""Control loop: early periods, Stop, telemetry rate and bases."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest

from device_agent.ports.driver import REST, DriverError, Observation, Twist
from device_agent.protocol import JointTarget, JointTelemetry, Mode, Setpoint, StopDevice, StopLatch
from device_agent.protocol.manifests.robot_type import Base
from device_agent.runtime import load
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control import control_loop as module
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.control_loop import ControlLoop
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.load import LoadGovernor
from tests.fakes.drivers import BASE, FakeDriver, robot_type
from tests.harness.agent.controller_fixture import ignore_revocation
from tests.harness.agent.device_harness import DeviceHarness
from tests.harness.agent.load import raise_level
from tests.harness.network.brokers import SILENCE_S, wait_until
from tests.unit.device_agent.runtime.conftest import MakeDevice

LONG_MS = 600_000
"""Longer than any test waits."""
AT_REST = Observation((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), ())
LATCH = StopLatch(caller="bob", reason="", at_ms=1)


class LoopFixture:
    """A control loop, which may run, and its operator."""

    def __init__(self, driver: FakeDriver | None = None, *, period_ms: int = LONG_MS, base: Base | None = None) -> None:
        kind = robot_type(base, period_ms=period_ms)
        self.driver = driver or FakeDriver()
        self.controller = Controller(kind, LeaseGate())
        self.controller.start_at((0.0, 0.0))
        self.controller.grant(epoch=1, holder="ann", lease_s=1000, now_s=time.monotonic())
        self.published: list[JointTelemetry] = []
        self.measured: list[tuple[Mode, bool]] = []
        self.load = LoadGovernor()
        self.loop = ControlLoop(
            kind,
            self.driver,
            self.controller,
            name="arm",
            publish=self.published.append,
            check_interlocks=lambda _now_s: None,
            measure=lambda _now_s, output, moving: self.measured.append((output.mode, moving)),
            load=self.load,
        )
        self._sequence = 0

    def send_setpoint(self, elbow_rad: float) -> None:
        self._sequence += 1
        target = JointTarget(position_rad={"elbow": elbow_rad})
        setpoint = Setpoint(epoch=1, sequence=self._sequence, echo_tick_ms=5, sent_ms=0.0, target=target)
        self.controller.accept_setpoint(setpoint, now_s=time.monotonic(), tick_ms=10)
        self.loop.wake()


MakeLoop = Callable[..., LoopFixture]


@pytest.fixture
def make_loop() -> Iterator[MakeLoop]:
    """Starts control loops, and waits for their first period."""
    fixtures: list[LoopFixture] = []

    def make(*args: Any, **options: Any) -> LoopFixture:
        fixtures.append(LoopFixture(*args, **options))
        fixtures[-1].loop.start()
        wait_until(lambda: fixtures[-1].loop._next_s > time.monotonic(), "the first period")
        return fixtures[-1]

    yield make
    for setup in fixtures:
        setup.loop.stop()


class InlineDriver(FakeDriver):
    """``threads`` are those that have commanded it."""

    prompt = True

    def __init__(self) -> None:
        super().__init__()
        self.threads: list[str] = []

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        self.threads.append(threading.current_thread().name)
        return super().send(position_rad)


@pytest.mark.parametrize(("mode", "moves"), [(Mode.ACTION, True), (Mode.IDLE, False)])
def test_a_robot_that_moves_itself_moves_in_an_action_only(mode: Mode, *, moves: bool) -> None:
    setup = LoopFixture()
    itself = Observation((0.0, 0.0), (0.0, 0.2), (0.0, 0.0), ())
    output = setup.controller.update(time.monotonic(), AT_REST.position_rad)
    assert setup.loop._moves(itself, replace(output, mode=mode)) is moves
    assert not setup.loop._moves(AT_REST, replace(output, mode=mode))


def test_a_lost_device_is_measured_at_rest(make_loop: MakeLoop) -> None:
    setup = make_loop(period_ms=20)
    with mock.patch.object(setup.driver, "observe", side_effect=DriverError("lost")):
        wait_until(lambda: (Mode.FAULT, False) in setup.measured, "the period of a lost device")


def test_a_device_at_rest_follows_one_of_several_setpoints_early(make_loop: MakeLoop) -> None:
    setup = make_loop()
    setup.send_setpoint(0.5)
    wait_until(lambda: setup.published[-1].setpoint_sequence == 1, "telemetry of it")
    assert setup.driver.position[1] == pytest.approx(0.5)
    setup.send_setpoint(0.7)
    time.sleep(SILENCE_S)
    assert setup.driver.position[1] == pytest.approx(0.5)


def test_an_inline_driver_is_commanded_by_the_callers_thread_until_the_stop(make_loop: MakeLoop) -> None:
    driver = InlineDriver()
    setup = make_loop(driver)
    setup.send_setpoint(0.5)
    assert driver.position[1] == pytest.approx(0.5)
    assert setup.published[-1].setpoint_sequence == 1
    setup.send_setpoint(0.7)  # the second one waits for its period of ten minutes
    assert driver.position[1] == pytest.approx(0.5)
    assert driver.threads[1:] == [threading.current_thread().name]
    setup.loop.stop()
    setup.loop._ran_early = False
    setup.send_setpoint(0.9)
    assert len(driver.threads) == 2


def test_a_full_period_follows_an_early_one(make_loop: MakeLoop) -> None:
    driver = InlineDriver()
    setup = make_loop(driver, period_ms=300)
    setup.loop._ran_early = False
    start_s = time.monotonic()
    setup.send_setpoint(0.5)
    commanded = len(driver.threads)
    wait_until(lambda: len(driver.threads) > commanded, "the next period")
    assert time.monotonic() - start_s >= 0.3


def test_a_blocked_period_does_not_prevent_stop(make_loop: MakeLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_STOP_TIMEOUT_S", 0.01)
    setup = make_loop()
    with setup.loop._period_lock:
        setup.loop.stop()
    assert setup.loop._stopping.is_set()


def test_concurrent_wakes_run_one_period(make_loop: MakeLoop) -> None:
    driver = InlineDriver()
    setup = make_loop(driver)
    real = setup.loop._period_lock

    class InterceptedLock:
        """Simulates that another thread ran a period while this one acquired the lock."""

        def acquire(self, **options: Any) -> bool:
            acquired = real.acquire(**options)
            setup.loop._ran_early = True
            return acquired

        def release(self) -> None:
            real.release()

        def __enter__(self) -> None:
            self.acquire()

        def __exit__(self, *_: object) -> None:
            self.release()

    setup.loop._period_lock = InterceptedLock()  # type: ignore[assignment]
    setup.send_setpoint(0.5)
    time.sleep(SILENCE_S)
    assert len(driver.threads) == 1


def test_an_error_in_any_period_is_a_fault_until_the_driver_responds(make_loop: MakeLoop) -> None:
    setup = make_loop(InlineDriver(), period_ms=8)
    setup.driver.broken = True
    wait_until(lambda: setup.controller.fault is not None, "the fault")
    setup.driver.broken = False
    wait_until(lambda: setup.controller.fault is None, "the driver's return")
    setup = make_loop(InlineDriver())
    setup.driver.refuses = True
    setup.send_setpoint(0.5)
    wait_until(lambda: setup.controller.fault == "no", "the fault of an early period")


@pytest.mark.parametrize("stop", [DeviceHarness.receive_stop, lambda harness: harness.command(StopDevice(reason=""))])
@pytest.mark.parametrize("driver", [FakeDriver, InlineDriver])
def test_a_stop_at_rest_does_not_wait_for_a_period(
    make_device: MakeDevice, driver: type[FakeDriver], stop: Callable[[DeviceHarness], object]
) -> None:
    harness = make_device(driver=driver(), kind=robot_type(period_ms=LONG_MS))
    loop = harness.device._loop
    assert isinstance(loop, ControlLoop)
    wait_until(lambda: loop._next_s > time.monotonic(), "the first period")
    stop(harness)
    wait_until(lambda: harness.device._controller.mode is Mode.STOPPED, "an early period")


def test_in_motion_periods_keep_their_length() -> None:
    setup = LoopFixture(InlineDriver(), period_ms=8)
    setup.send_setpoint(0.5)
    assert setup.loop._wait()
    setup.controller.update(time.monotonic())
    assert setup.controller.moving
    setup.send_setpoint(0.6)
    assert not setup.loop._wait()
    assert setup.driver.position[1] == 0.0, "no period has run"


class ManualTime:
    """Stands in for the module ``time``; advances only by assignment."""

    def __init__(self) -> None:
        self.now_s = time.monotonic()

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def moving(monkeypatch: pytest.MonkeyPatch) -> LoopFixture:
    """An arm that moves, a quarter of a period after the last one. The loop's own thread does not run."""
    setup, clock = LoopFixture(InlineDriver(), period_ms=4), ManualTime()
    monkeypatch.setattr(module, "time", clock)
    setup.loop._next_s = clock.now_s
    setup.loop._thread = mock.Mock(responsive=True)
    setup.loop._ran_early = True
    setup.send_setpoint(2.5)
    for _ in range(20):
        clock.now_s = setup.loop._next_s
        setup.loop._run_period(early=False)
    clock.now_s += 0.001
    assert setup.controller.mode is Mode.STREAMING
    assert setup.controller.moving
    return setup


def test_a_stop_in_motion_brakes_immediately_for_the_elapsed_time(moving: LoopFixture) -> None:
    setup = moving
    assert isinstance(setup.driver, InlineDriver)
    before_rad, speed_rad_s = setup.driver.position[1], setup.controller._state.motion.velocity_rad_s[1]
    commanded = len(setup.driver.threads)
    setup.controller.stop(LATCH)
    setup.loop.wake()
    assert setup.controller.mode is Mode.STOPPED
    assert len(setup.driver.threads) == commanded + 1
    assert 0 < setup.driver.position[1] - before_rad <= speed_rad_s * 0.0011
    assert setup.controller.moving, "it brakes, it does not jump"
    setup.loop.wake()
    assert len(setup.driver.threads) == commanded + 1, "only once: then periods keep their length again"


@pytest.mark.parametrize("running", [False, True])
def test_a_stop_does_not_wait_after_an_early_period_but_for_a_running_one(moving: LoopFixture, running: bool) -> None:
    setup = moving
    setup.loop._ran_early = not running
    setup.controller.stop(LATCH)
    if not running:
        setup.loop.wake()
        assert setup.controller.mode is Mode.STOPPED
        return
    setup.loop._period_s = 60.0  # longest wait for a running period
    setup.loop._period_lock.acquire()
    threading.Timer(0.02, setup.loop._period_lock.release).start()
    setup.loop.wake()
    assert setup.controller.mode is Mode.STOPPED


def test_the_elapsed_time_is_bounded() -> None:
    loop = LoopFixture(period_ms=4).loop
    loop._next_s = 10.0
    elapsed_s = [loop._elapsed_s(now_s) for now_s in (9.0, 9.996, 9.998, 10.0, 11.0)]
    assert elapsed_s == pytest.approx([0.0001, 0.0001, 0.002, 0.004, 0.004])


def test_telemetry_follows_setpoints_within_its_rate_limit_or_at_33_hz() -> None:
    setup = LoopFixture()
    output = setup.controller.update(0.0)

    def publish(now_s: float, sequence: int, mode: Mode = Mode.STREAMING) -> bool:
        count = len(setup.published)
        changed = replace(output, setpoint_sequence=sequence, mode=mode)
        setup.loop._publish_telemetry(now_s, AT_REST, changed, (0.0, 0.0))
        return len(setup.published) > count

    cases = ((0.0, 0), (0.03, 0), (0.03, 1), (0.04, 2), (0.045, 3), (0.0501, 3))
    assert [publish(*case, Mode.IDLE) for case in cases] == [True, False, True, True, False, True]
    setup.published.clear()
    for period in range(2002):
        publish(10 + period / 1000, min(period // 25, 40))
    assert [each.setpoint_sequence for each in setup.published[:41]] == list(range(41))
    assert 32 <= len(setup.published[41:]) <= 34


class Cart(FakeDriver):
    """A base, which may not move as commanded."""

    def __init__(self, applied: Twist | None = None) -> None:
        super().__init__()
        self.applied = applied
        self.twists: list[Twist] = []

    def drive(self, twist: Twist) -> Twist:
        self.twists.append(twist)
        return self.applied or twist


@pytest.mark.parametrize(("applied", "limited"), [(None, ()), (REST, ("base: driver",))])
def test_the_driver_receives_twists_until_the_drive_ends(
    make_loop: MakeLoop, applied: Twist | None, limited: tuple[str, ...]
) -> None:
    cart = Cart(applied)
    setup = make_loop(cart, period_ms=8, base=BASE)
    reservation = setup.controller.reserve(epoch=1, on_revoked=ignore_revocation)
    drive = setup.controller.start_drive(reservation, Twist(0.2), duration_s=0.3)
    wait_until(drive.finished.is_set, "the end of the drive")
    assert drive.result is GoalResult.REACHED
    assert drive.limited == limited
    assert 0 < max(twist.forward_m_s for twist in cart.twists) <= 0.2 + 1e-9
    assert cart.twists[-1] == pytest.approx(REST, abs=1e-6)


def test_a_type_with_a_base_needs_a_mobile_driver() -> None:
    setup = LoopFixture(base=BASE)
    with pytest.raises(DriverError, match="'arm' has a base, but its driver cannot drive"):
        setup.loop.start()
    setup.loop.stop()


@pytest.mark.parametrize(("mode", "share"), [(Mode.IDLE, 0.5), (Mode.ACTION, 0.5), (Mode.STREAMING, 1.0)])
def test_an_overloaded_agent_sends_less_telemetry_except_to_an_operator_who_steers(mode: Mode, share: float) -> None:
    setup = LoopFixture()
    output = ControlOutput([0.0, 0.0], mode, 1, 0, 0.0, 0.0, ())

    def messages(start_s: float) -> int:
        return sum(setup.loop._is_due(start_s + number * 0.01, output) for number in range(400))

    usual = messages(1000.0)
    raise_level(setup.load, 3)
    assert messages(2000.0) == pytest.approx(usual * share, abs=2)


def test_a_late_period_raises_the_load_level_and_still_commands(
    make_loop: MakeLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = InlineDriver()
    setup = make_loop(driver)
    monkeypatch.setattr(load, "WINDOW_S", 0.0)
    monkeypatch.setattr(load, "MIN_PERIODS", 1)
    commanded = len(driver.threads)
    with setup.loop._period_lock:
        setup.loop._next_s = time.monotonic() - 2 * LONG_MS / 1000
        setup.loop._run_period(early=False)
        assert setup.load.level == 1
    assert len(driver.threads) == commanded + 1
