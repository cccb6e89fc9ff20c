"""The control loop of one device: observe, decide, command, every ``period_ms``. The only writer of motor commands.

While the device rests, a setpoint or a move does not wait for the next period: its own begins when it comes. In motion
periods keep their length, for each carries one period's way; but for a Stop's, which brakes for as long as has passed.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.driver import Driver, DriverError, MobileDriver, Observation, RunsInline
from device_agent.protocol import JointTelemetry, Mode
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.controller import Controller

IDLE_RATE_HZ = 20.0
MOVING_RATE_HZ = 50.0
_STREAMING_GAP_S = 0.03
"""Telemetry goes with the setpoints while they come: a word between two of them, which a console sends 25 ms apart,
would only stand in the way of the next one's."""
_RECONNECT_EVERY_S = 1.0
_REST_WITHIN_S = 1.0
_LEAST_S = 1e-4
"""What has passed at least since a period when a Stop begins the next: of nothing ``ruckig`` plans nothing."""
_log = logging.getLogger(__name__)


class ControlLoop:
    """One thread that never waits for disk or network; setpoints for a device at rest may bring their own (``hurry``).

    Args:
        robot_type: The control period.
        driver: Not yet connected; this loop alone calls ``observe`` and ``send``.
        controller: Decides.
        name: The device's name.
        tell: Called with telemetry, 20 times a second at rest and 50 times in motion, and while setpoints come with
            each of them as soon as it is applied, at most 50 times a second; must not block.
        watch: Called before each decision with the monotonic clock [s]: the room's interlocks. Quick; an error holds.
    """

    def __init__(
        self,
        robot_type: RobotType,
        driver: Driver,
        controller: Controller,
        *,
        name: str,
        tell: Callable[[JointTelemetry], None],
        watch: Callable[[float], None],
    ) -> None:
        self._period_s = robot_type.period_ms / 1000
        self._driver = driver
        self._base = driver if robot_type.base is not None and isinstance(driver, MobileDriver) else None
        self._lacks_base = robot_type.base is not None and self._base is None
        self._controller = controller
        self._name = name
        self._tell = tell
        self._watch = watch
        self._sequence = 0
        self._next_telemetry_s = 0.0
        self._spent_s = 0.0
        self._told_setpoint = 0
        self._shown: tuple[Observation, Observation] | None = None
        self._next_s = 0.0
        self._early = False
        self._trouble = ""
        self._prompt = isinstance(driver, RunsInline) and driver.prompt
        self._asked = threading.Event()
        self._turn = threading.Lock()  # of whoever runs a period
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name}-loop", daemon=True)
        self.seen: Observation | None = None

    def start(self) -> None:
        """Connect the driver and hold where the device is.

        Raises:
            DriverError: The device is not there, or its driver cannot move the base that it should have.
        """
        if self._lacks_base:
            raise DriverError(f"the robot type of '{self._name}' has a base, but its driver cannot drive")
        self._driver.connect()
        self.seen = self._driver.observe()
        self._controller.start_at(self.seen.position_rad)
        self._thread.start()

    def stop(self) -> None:
        """Wait for rest, a second at most, and end the thread. May be called twice."""
        deadline_s = time.monotonic() + _REST_WITHIN_S
        while self._controller.moving and self._thread.is_alive() and time.monotonic() < deadline_s:
            time.sleep(self._period_s)
        self._stopping.set()
        self._asked.set()
        if self._turn.acquire(timeout=2):  # whoever is in a period ends it; then the driver may be closed
            self._turn.release()
        if self._thread.is_alive():
            self._thread.join(timeout=2)

    def hurry(self) -> None:
        """Something is asked of a device: while it rests its period begins now, here if the driver is ``RunsInline``.

        So does a Stop's while it moves, where the driver is ``RunsInline``; else a Stop waits for the period that comes.
        """
        # A period that runs may have decided before the Stop was there.
        if self._prompt and self._turn.acquire(timeout=self._period_s if self._controller.stops else 0):
            try:
                if self._free() and self._thread.is_alive() and not self._stopping.is_set():
                    self._period(early=True)
                    return
            finally:
                self._turn.release()
        self._asked.set()

    def _free(self) -> bool:
        """Whether a period may begin early: a Stop's always, others at rest and not twice running."""
        return not self._trouble and (self._controller.stops or not (self._early or self._controller.moving))

    def _run(self) -> None:
        self._next_s = time.monotonic()
        while not self._stopping.is_set():
            early = self._wait()
            with self._turn:
                if self._stopping.is_set():
                    return
                if self._trouble:
                    self._fail()
                elif time.monotonic() >= self._next_s:
                    self._period(early=False)
                elif early and self._free():  # else somebody has just had a period of their own
                    self._period(early=True)

    def _wait(self) -> bool:
        """Sleep until the next period, or until something is asked of a device at rest; whether it was."""
        pause_s = max(0.0, self._next_s - time.monotonic())
        if self._early or self._controller.moving:
            time.sleep(pause_s)
            return False
        return self._asked.wait(pause_s)

    def _period(self, *, early: bool) -> None:
        """Observe, decide, command, tell; ``_trouble`` is what went wrong. Its caller has the turn."""
        now_s = time.monotonic()
        self._asked.clear()  # what has come until here is decided upon below
        try:
            # What rests is where the period before has seen it.
            seen = self.seen = self.seen if early and self.seen is not None else self._driver.observe()
            self._watch(now_s)
            passed_s = self._passed_s(now_s) if early and self._controller.moving else None
            tick = self._controller.step(now_s, seen.position_rad, passed_s=passed_s)
            applied = self._driver.send(tick.position_rad)
            self._controller.applied(applied)
            if self._base is not None:
                self._controller.driven(tick.twist, self._base.drive(tick.twist))
            self._measure(now_s, seen, tick, applied)
        except DriverError as error:
            self._trouble = str(error)
        except Exception as error:  # noqa: BLE001 (whatever it is: hold until the driver answers)
            _log.exception("%s: control loop", self._name)
            self._trouble = f"internal error: {error}"
        if self._trouble:
            self._asked.set()  # for the loop's own thread, which sees to it
        self._early = early
        # Late periods are dropped, never made up for: a burst of commands would be a jump.
        begun_s = now_s if early else max(self._next_s, time.monotonic() - 2 * self._period_s)
        self._next_s = begun_s + self._period_s

    def _passed_s(self, now_s: float) -> float:
        """Of the period that would end next [s]."""
        return min(max(now_s - (self._next_s - self._period_s), _LEAST_S), self._period_s)

    def _fail(self) -> None:
        _log.error("%s: %s", self._name, self._trouble)
        self._controller.fail(self._trouble)
        self._controller.step(time.monotonic())
        while not self._stopping.wait(_RECONNECT_EVERY_S):
            with contextlib.suppress(DriverError):
                self._driver.connect()
                self.seen = self._driver.observe()
                self._controller.recover(self.seen.position_rad)
                self._trouble = ""
                return

    def _measure(self, now_s: float, seen: Observation, tick: ControlOutput, applied: tuple[float, ...]) -> None:
        if not self._due(now_s, tick):
            if tick.mode is Mode.STREAMING:
                self._show(seen)  # so that the next setpoint finds it done
            return
        shown = self._show(seen)
        self._sequence += 1
        self._tell(
            JointTelemetry(
                tick_ms=tick_ms(),
                at_ms=wall_ms(),
                sequence=self._sequence,
                mode=tick.mode,
                position_rad=shown.position_rad,
                velocity_rad_s=shown.velocity_rad_s,
                effort_nm=shown.effort_nm,
                commanded_rad=_rounded(applied),
                frames=shown.frames,
                epoch=tick.epoch,
                setpoint_sequence=tick.setpoint_sequence,
                setpoint_sent_ms=tick.setpoint_sent_ms,
                loop_age_ms=tick.loop_age_ms,
                limited=tick.limited,
            )
        )

    def _show(self, seen: Observation) -> Observation:
        """An observation as telemetry shows it."""
        if self._shown is None or self._shown[0] is not seen:
            shown = Observation(
                position_rad=_rounded(seen.position_rad),
                velocity_rad_s=_rounded(seen.velocity_rad_s),
                effort_nm=_rounded(seen.effort_nm),
                frames=tuple([(x, y, z, w, i, j, k) for x, y, z, w, i, j, k in _rounded(seen.frames)]),
            )
            self._shown = seen, shown
        return self._shown[1]

    def _due(self, now_s: float, tick: ControlOutput) -> bool:
        """Whether telemetry is to be told: a regular word, or news of a setpoint. Two may be close, many may not."""
        gap_s = 1 / MOVING_RATE_HZ
        news = tick.setpoint_sequence != self._told_setpoint and now_s >= self._spent_s - gap_s
        if now_s < self._next_telemetry_s and not news:
            return False
        if tick.mode is Mode.STREAMING:
            self._next_telemetry_s = now_s + _STREAMING_GAP_S
        else:
            busy = tick.mode is Mode.ACTION or self._controller.moving
            due_s = min(self._next_telemetry_s, now_s) + (gap_s if busy else 1 / IDLE_RATE_HZ)
            self._next_telemetry_s = max(now_s, due_s)
        self._spent_s = max(self._spent_s, now_s) + gap_s
        self._told_setpoint = tick.setpoint_sequence
        return True


def _rounded(values: Sequence[Any]) -> tuple[Any, ...]:
    """Six decimals: a microradian or a micrometre, far below any encoder, at half the bytes."""
    return tuple(np.round(np.array(values, dtype=np.float64), 6).tolist())
