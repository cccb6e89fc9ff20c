"""The control loop of one device: observe, decide, command, every ``period_ms``. The only writer of motor commands.

While the device rests, a setpoint does not wait for the next period: its own begins when it comes. In motion periods
keep their length, for each carries one period's way.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.driver import Driver, DriverError, MobileDriver, Observation
from device_agent.protocol.messages import JointTelemetry, Mode
from device_agent.protocol.robot_type import RobotType
from device_agent.runtime.controller import Controller
from device_agent.runtime.pilot import Tick

IDLE_RATE_HZ = 20.0
MOVING_RATE_HZ = 50.0
_RECONNECT_EVERY_S = 1.0
_REST_WITHIN_S = 1.0
_log = logging.getLogger(__name__)


class ControlLoop:
    """One thread that never waits for disk or network.

    Args:
        robot_type: The control period.
        driver: Not yet connected; this loop alone calls ``observe`` and ``send``.
        controller: Decides.
        name: The device's name.
        tell: Called with telemetry, 20 times a second at rest and 50 times in motion, and as soon as a new setpoint is
            applied, though never more than 50 times a second; must not block.
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
        self._told_s = 0.0
        self._told_setpoint = 0
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
        if self._thread.is_alive():
            self._thread.join(timeout=2)

    def _run(self) -> None:
        next_s, early = time.monotonic(), False
        while not self._stopping.is_set():
            now_s = time.monotonic()
            self._controller.asked.clear()  # what has come until here is decided upon below
            try:
                self.seen = self._driver.observe()
                self._watch(now_s)
                tick = self._controller.step(now_s, self.seen.position_rad)
                applied = self._driver.send(tick.position_rad)
                self._controller.applied(applied)
                if self._base is not None:
                    self._controller.driven(tick.twist, self._base.drive(tick.twist))
                self._measure(now_s, self.seen, tick, applied)
            except DriverError as error:
                self._fail(str(error))
            except Exception as error:  # noqa: BLE001 (whatever it is: hold until the driver answers)
                _log.exception("%s: control loop", self._name)
                self._fail(f"internal error: {error}")
            # Late periods are dropped, never made up for: a burst of commands would be a jump.
            next_s = max(next_s + self._period_s, time.monotonic() - self._period_s)
            # Not twice running, so that a flood of setpoints makes no more than twice the periods.
            early = self._wait(next_s, sooner=not early)
            if early:
                next_s = time.monotonic()

    def _wait(self, next_s: float, *, sooner: bool) -> bool:
        """Sleep until the next period, or with ``sooner`` until a setpoint for a device at rest; whether one came."""
        pause_s = max(0.0, next_s - time.monotonic())
        if sooner and not self._controller.moving:
            return self._controller.asked.wait(pause_s)
        time.sleep(pause_s)
        return False

    def _fail(self, message: str) -> None:
        _log.error("%s: %s", self._name, message)
        self._controller.fail(message)
        self._controller.step(time.monotonic())
        while not self._stopping.wait(_RECONNECT_EVERY_S):
            with contextlib.suppress(DriverError):
                self._driver.connect()
                self.seen = self._driver.observe()
                self._controller.recover(self.seen.position_rad)
                return

    def _measure(self, now_s: float, seen: Observation, tick: Tick, applied: tuple[float, ...]) -> None:
        news = tick.setpoint_sequence != self._told_setpoint and now_s >= self._told_s + 1 / MOVING_RATE_HZ
        if now_s < self._next_telemetry_s and not news:
            return
        busy = tick.mode in (Mode.STREAMING, Mode.ACTION) or self._controller.moving
        due_s = min(self._next_telemetry_s, now_s) + 1 / (MOVING_RATE_HZ if busy else IDLE_RATE_HZ)
        self._next_telemetry_s, self._told_s = max(now_s, due_s), now_s
        self._told_setpoint = tick.setpoint_sequence
        self._sequence += 1
        self._tell(
            JointTelemetry(
                tick_ms=tick_ms(),
                at_ms=wall_ms(),
                sequence=self._sequence,
                mode=tick.mode,
                position_rad=_rounded(seen.position_rad),
                velocity_rad_s=_rounded(seen.velocity_rad_s),
                effort_nm=_rounded(seen.effort_nm),
                commanded_rad=_rounded(applied),
                frames=seen.frames,
                epoch=tick.epoch,
                setpoint_sequence=tick.setpoint_sequence,
                setpoint_sent_ms=tick.setpoint_sent_ms,
                loop_age_ms=tick.loop_age_ms,
                limited=tick.limited,
            )
        )


def _rounded(values: tuple[float, ...]) -> tuple[float, ...]:
    """Six decimals: a microradian, far below any encoder, at half the bytes."""
    return tuple(round(value, 6) for value in values)
