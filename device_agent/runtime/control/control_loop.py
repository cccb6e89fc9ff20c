"""Control loop of one device: observe, compute, command, every ``period_ms``. The only writer of motor commands.

A device at rest starts a setpoint or goal in an additional period, without waiting for the next regular one. While
the device moves, periods keep their length, because each carries one period of motion. Only a Stop shortens a period.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.driver import (
    Driver,
    DriverError,
    DriverFault,
    MobileDriver,
    Observation,
    ReportsFaults,
    RunsInline,
    UnreachableError,
)
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.protocol import Fault, JointTelemetry, Mode, StopLatch
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control import measurement
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import INTERNAL_ERROR
from device_agent.runtime.load import LoadGovernor

IDLE_RATE_HZ = 20.0
MOVING_RATE_HZ = 50.0
_STREAMING_GAP_S = 0.03
"""Gap between telemetry messages while setpoints arrive [s].

Each setpoint triggers a message. Consoles send setpoints 25 ms apart; a message in between would delay the next one.
"""
_RECONNECT_PERIOD_S = 1.0
_REST_TIMEOUT_S = 1.0
_STOP_TIMEOUT_S = 2.0
RESPONSE_S = 0.7
"""A loop without a new period for this time hangs [s]; with the supervisor's period it is noticed within 1 s."""
_CONNECT_S = 30.0
"""Maximum time of a reconnection, during which the device holds [s]."""
REST_RAD_S = 0.05
"""A joint that is measured below this speed is at rest; above the noise of encoders [rad/s]."""
CONTROL_LOOP = "control loop"
_MIN_ELAPSED_S = 1e-4
"""Lower bound of the time since the last period: ``ruckig`` cannot plan for a duration of 0 [s]."""
_log = logging.getLogger(__name__)


class Period(NamedTuple):
    """One control period: its start [s], what was observed, commanded and applied, and whether the robot moves."""

    now_s: float
    observation: Observation
    output: ControlOutput
    applied_rad: Sequence[float]
    moving: bool


class ControlLoop:
    """One thread that never waits for disk or network. Callers of ``wake`` may run a period in their own thread.

    ``publish`` receives telemetry at 20 Hz at rest, at 50 Hz in motion, and with each applied setpoint at up to 50 Hz.
    ``check_interlocks`` is called before each period with the monotonic clock [s], ``measure`` after each period with
    the clock, its output and whether the robot moves, and then ``record`` with the period. None of them may block.
    """

    def __init__(
        self,
        robot_type: RobotType,
        driver: Driver,
        controller: Controller,
        *,
        name: str,
        publish: Callable[[JointTelemetry], None],
        check_interlocks: Callable[[float], None],
        measure: Callable[[float, ControlOutput, bool], None],
        load: LoadGovernor,
        record: Callable[[Period], None] | None = None,
    ) -> None:
        self._load = load
        self._record = record
        self._measure = measure
        self._period_s = robot_type.period_ms / 1000
        self._driver = driver
        self._base = driver if robot_type.base is not None and isinstance(driver, MobileDriver) else None
        self._lacks_base = robot_type.base is not None and self._base is None
        self._reports_faults = driver if isinstance(driver, ReportsFaults) else None
        self._device_faults: tuple[DriverFault, ...] = ()
        self._device_stopped = False
        self._joints = len(robot_type.joints)
        self._controller = controller
        self._name = name
        self._publish = publish
        self._check_interlocks = check_interlocks
        self._sequence = 0
        self._next_telemetry_s = 0.0
        self._budget_s = 0.0
        self._published_setpoint = 0
        self._rounded: tuple[Observation, Observation] | None = None
        self._next_s = 0.0
        self._ran_early = False
        self._error = self._logged = ""
        self._runs_inline = isinstance(driver, RunsInline) and driver.prompt
        self._requested = threading.Event()
        self._period_lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name=f"{name}-loop",
            part=CONTROL_LOOP,
            device=name,
            stopping=self._stopping,
            recovery=Recovery.EXIT,
            within_s=self._period_s + RESPONSE_S,
        )
        self.observation: Observation | None = None

    def start(self) -> None:
        """Connect the driver and hold the present position. An unreachable device has a fault until it responds.

        Raises:
            DriverError: The device can never be used, or its driver cannot drive the base of the robot type.
        """
        if self._lacks_base:
            raise DriverError(f"the robot type of '{self._name}' has a base, but its driver cannot drive")
        try:
            self._driver.connect()
            self.observation = self._observe()
            self._controller.start_at(self.observation.position_rad)
        except UnreachableError as error:
            self._error = str(error)
            self._controller.set_fault(self._error)
        self._thread.start()

    def faults(self) -> tuple[Fault, ...]:
        """Faults that the device reports itself. Thread-safe."""
        return tuple(
            Fault(code=f"driver.{fault.code}", message=fault.message[:2000], since_ms=wall_ms())
            for fault in self._device_faults
        )

    def fail(self, message: str) -> None:
        """Stop the device without the loop, which has ended or hangs. If it responds again, it reconnects."""
        self._halt()
        self._error = message
        self._controller.set_fault(message)

    def _halt(self) -> None:
        try:
            self._driver.halt()
        except Exception:  # noqa: BLE001 (a defect of the driver must not end the thread that reports it)
            _log.exception("%s: the driver cannot be halted", self._name)

    def stop(self) -> None:
        """Wait up to a second for rest, and end the thread. May be called twice."""
        deadline_s = time.monotonic() + _REST_TIMEOUT_S
        while self._controller.moving and self._thread.is_alive() and time.monotonic() < deadline_s:
            time.sleep(self._period_s)
        self._stopping.set()
        self._requested.set()
        if self._period_lock.acquire(
            timeout=_STOP_TIMEOUT_S
        ):  # a running period ends first; then the driver may be closed
            self._period_lock.release()
        self._thread.join(timeout=_STOP_TIMEOUT_S)

    def wake(self) -> None:
        """Start the next period now if the device is at rest, in this thread if the driver is ``RunsInline``.

        A pending Stop also interrupts motion if the driver is ``RunsInline``; otherwise it waits for the next period.
        If the loop has ended or hangs, the driver is halted instead.
        """
        if self._controller.stop_pending and not self._thread.responsive:
            self._halt()
            return
        # A running period may have been computed before the Stop arrived.
        timeout_s = self._period_s if self._controller.stop_pending else 0
        if self._runs_inline and self._period_lock.acquire(timeout=timeout_s):
            try:
                if self._may_run_early() and self._thread.is_alive() and not self._stopping.is_set():
                    self._run_period(early=True)
                    return
            finally:
                self._period_lock.release()
        self._requested.set()

    def _may_run_early(self) -> bool:
        """Whether a period may run early: always for a Stop, otherwise at rest and not twice in a row."""
        at_rest = not (self._ran_early or self._controller.moving)
        return not self._error and (self._controller.stop_pending or at_rest)

    def _run(self) -> None:
        self._next_s = time.monotonic()
        while not self._stopping.is_set():
            self._thread.beat()
            early = self._wait()
            with self._period_lock:
                if self._stopping.is_set():
                    return
                if self._error:
                    self._handle_fault()
                elif time.monotonic() >= self._next_s:
                    self._run_period(early=False)
                elif early and self._may_run_early():  # otherwise another thread has just run a period
                    self._run_period(early=True)

    def _wait(self) -> bool:
        """Sleep until the next period. Returns True if a device at rest was woken earlier."""
        pause_s = max(0.0, self._next_s - time.monotonic())
        if self._ran_early or self._controller.moving:
            self._stopping.wait(pause_s)
            return False
        return self._requested.wait(pause_s)

    def _run_period(self, *, early: bool) -> None:
        """Observe, compute, command, publish; sets ``_error`` on failure. The caller holds the period lock."""
        now_s = time.monotonic()
        if not early:
            self._load.record_period(now_s, late_s=now_s - self._next_s, period_s=self._period_s)
        self._requested.clear()  # this period includes all requests so far
        try:
            # A device at rest is where the previous period observed it.
            observation = (early and self.observation) or self._observe()
            self.observation = observation
            self._check_interlocks(now_s)
            self._update_device_stop(observation)
            elapsed_s = self._elapsed_s(now_s) if early and self._controller.moving else None
            output = self._controller.update(
                now_s, observation.position_rad, elapsed_s=elapsed_s, settled=observation.settled
            )
            applied = observation.position_rad if self._device_stopped else self._command(output)
            self._controller.record_period(output)
            moving = self._moves(observation, output)
            self._measure(now_s, output, moving)
            if self._record is not None:
                self._record(Period(now_s, observation, output, applied, moving))
            self._publish_telemetry(now_s, observation, output, applied)
        except DriverError as error:
            self._error = str(error)
        except Exception as error:  # noqa: BLE001 (any error holds the device until the driver responds)
            self._error = INTERNAL_ERROR
            if repr(error) != self._logged:
                _log.exception("%s: control loop", self._name)
            self._logged = repr(error)
        if self._error:
            self._requested.set()  # wakes the loop's thread, which handles the fault
        self._ran_early = early
        # Late periods are dropped and not repeated: a burst of commands would be a jump.
        start_s = now_s if early else max(self._next_s, time.monotonic() - 2 * self._period_s)
        self._next_s = start_s + self._period_s

    def _command(self, output: ControlOutput) -> tuple[float, ...]:
        """Send the commands of a period. Returns the applied positions, shape (n,) [rad]."""
        applied = self._driver.send(output.position_rad)
        self._controller.record_applied(applied)
        if self._base is not None:
            self._controller.record_driven(output.twist, self._base.drive(output.twist))
        return applied

    def _moves(self, observation: Observation, output: ControlOutput) -> bool:
        """Whether the robot is commanded to move, or moves itself in an action."""
        measured = output.mode is Mode.ACTION and any(abs(each) > REST_RAD_S for each in observation.velocity_rad_s)
        return measured or self._controller.moving

    def _observe(self) -> Observation:
        """The newest valid measurement.

        Raises:
            DriverError: The device does not respond, or its measurement is invalid or outdated.
        """
        observation = self._driver.observe()
        measurement.check(observation, joints=self._joints, now_s=time.monotonic())
        return observation

    def _update_device_stop(self, observation: Observation) -> None:
        """Latch Stop and follow the measured position while the device reports that it has stopped itself."""
        if self._reports_faults is None:
            return
        self._device_faults = tuple(self._reports_faults.faults())
        reason = next((fault.message[:2000] for fault in self._device_faults if fault.stops), None)
        if reason is not None:
            latch = StopLatch(caller="the device", reason=reason, at_ms=wall_ms(), verified=True)
            self._controller.follow_device_stop(latch, observation.position_rad)
        elif self._device_stopped:
            self._controller.clear_fault(observation.position_rad)
        self._device_stopped = reason is not None

    def _elapsed_s(self, now_s: float) -> float:
        """Time since the start of the present period [s]."""
        return min(max(now_s - (self._next_s - self._period_s), _MIN_ELAPSED_S), self._period_s)

    def _handle_fault(self) -> None:
        self._device_faults = ()  # unknown
        self._controller.set_fault(self._error)
        output = self._controller.update(time.monotonic())
        self._controller.record_period(output)
        self._thread.beat(_CONNECT_S)
        while not self._stopping.wait(_RECONNECT_PERIOD_S):
            self._thread.beat(_CONNECT_S)
            self._measure(time.monotonic(), output, False)
            with contextlib.suppress(Exception):  # a defect of the driver was logged; the loop must not end
                self._driver.connect()
                self.observation = self._observe()
                self._controller.clear_fault(self.observation.position_rad)
                self._error = ""
                return

    def _publish_telemetry(
        self, now_s: float, observation: Observation, output: ControlOutput, applied: tuple[float, ...]
    ) -> None:
        if not self._is_due(now_s, output):
            if output.mode is Mode.STREAMING:
                self._round(observation)  # prepared for the next setpoint
            return
        rounded = self._round(observation)
        self._sequence += 1
        self._publish(
            JointTelemetry(
                tick_ms=tick_ms(),
                at_ms=wall_ms(),
                sequence=self._sequence,
                mode=output.mode,
                position_rad=rounded.position_rad,
                velocity_rad_s=rounded.velocity_rad_s,
                effort_nm=rounded.effort_nm,
                commanded_rad=_round_values(applied),
                frames=rounded.frames,
                epoch=output.epoch,
                setpoint_sequence=output.setpoint_sequence,
                setpoint_sent_ms=output.setpoint_sent_ms,
                loop_age_ms=output.loop_age_ms,
                ended_input=output.ended_input,
                limited=output.limited,
            )
        )

    def _round(self, observation: Observation) -> Observation:
        """The observation rounded for telemetry."""
        if self._rounded is None or self._rounded[0] is not observation:
            rounded = Observation(
                position_rad=_round_values(observation.position_rad),
                velocity_rad_s=_round_values(observation.velocity_rad_s),
                effort_nm=_round_values(observation.effort_nm),
                frames=tuple([(x, y, z, w, i, j, k) for x, y, z, w, i, j, k in _round_values(observation.frames)]),
            )
            self._rounded = observation, rounded
        return self._rounded[1]

    def _is_due(self, now_s: float, output: ControlOutput) -> bool:
        """Whether to publish: at the regular rate, or for a new setpoint within a budget of ``MOVING_RATE_HZ``."""
        gap_s = 1 / MOVING_RATE_HZ
        new_setpoint = output.setpoint_sequence != self._published_setpoint and now_s >= self._budget_s - gap_s
        if now_s < self._next_telemetry_s and not new_setpoint:
            return False
        if output.mode is Mode.STREAMING:
            self._next_telemetry_s = now_s + _STREAMING_GAP_S
        else:
            busy = output.mode is Mode.ACTION or self._controller.moving
            regular_s = (gap_s if busy else 1 / IDLE_RATE_HZ) / self._load.share("telemetry")
            due_s = min(self._next_telemetry_s, now_s) + regular_s
            self._next_telemetry_s = max(now_s, due_s)
        self._budget_s = max(self._budget_s, now_s) + gap_s
        self._published_setpoint = output.setpoint_sequence
        return True


def _round_values(values: Sequence[Any]) -> tuple[Any, ...]:
    """Six decimals: a microradian or a micrometre, far below any encoder, at half the bytes."""
    return tuple(np.round(np.array(values, dtype=np.float64), 6).tolist())
