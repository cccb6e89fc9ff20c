"""The loop of a room device: reads each stream and camera at its rate, and watches over Stop, lease and interlocks.

It stands where a robot's control loop stands. A sensor may take its time: one that is slow makes nobody else wait.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.driver import Observation
from device_agent.ports.sensor import Camera, SensorError
from device_agent.protocol import MAX_VALUES, Measurements, Mode
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.room.room_device import RoomDevice

_LOOK_S = 0.05
"""How often it looks whether the device is stopped or held."""
_RECONNECT_EVERY_S = 1.0
_BUSY = frozenset({Mode.STOPPED, Mode.HOLDING, Mode.FAULT})
"""Modes in which nothing of the device may move."""
_NOTHING = Observation((), (), (), ())
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Source:
    """A stream or camera: when it is due [s], and how many it has given."""

    name: str
    film: bool
    due_s: float = 0.0
    sequence: int = 0


class SensorLoop:
    """One thread, which reads what is due.

    Args:
        instrument: Its driver is not yet connected.
        controller: Who may use it.
        name: The device's name.
        tell: Called with a stream's name and its measurement; must not block.
        film: Called with a camera's name and its picture; must not block.
        watch: Called before each look with the monotonic clock [s]: the room's interlocks. An error holds.
    """

    def __init__(
        self,
        instrument: RoomDevice,
        controller: Controller,
        *,
        name: str,
        tell: Callable[[str, Measurements], None],
        film: Callable[[str, CameraFrame], None],
        watch: Callable[[float], None],
    ) -> None:
        self._driver = instrument.driver
        self._camera = instrument.driver if isinstance(instrument.driver, Camera) else None
        self._instrument = instrument
        self._controller = controller
        self._name = name
        self._tell = tell
        self._film = film
        self._watch = watch
        self._sources = [_Source(stream, film=False) for stream in instrument.streams]
        self._sources += [_Source(camera, film=True) for camera in instrument.cameras]
        self._held = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name}-sensing", daemon=True)
        self.seen: Observation | None = None

    def start(self) -> None:
        """Connect the driver and begin to read. A sensor that is not there is a fault, and no reason to run nothing."""
        self.seen = _NOTHING
        self._controller.start_at(())
        try:
            self._driver.connect()
        except SensorError as error:
            self._failed(str(error))
        self._instrument.vigil.begin()
        self._thread.start()

    def stop(self) -> None:
        """End the thread. May be called twice."""
        self._stopping.set()
        self._instrument.changed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2)

    def hurry(self) -> None:
        """See ``ControlLoop.hurry``: nothing here follows setpoints."""

    def _run(self) -> None:
        while not self._stopping.is_set():
            now_s = time.monotonic()
            try:
                if self._controller.fault is not None:
                    self._driver.connect()
                    self._instrument.vigil.begin()
                    self._controller.recover(())
                self._watch(now_s)
                self._heed(self._controller.step(now_s).mode)
                for source in self._sources:
                    if source.due_s <= now_s:
                        self._take(source, now_s)
            except SensorError as error:
                self._failed(str(error))
            except Exception as error:  # noqa: BLE001 (whatever it is: a sensor that is silent must say why)
                _log.exception("%s: sensing", self._name)
                self._failed(f"internal error: {error}")
            self._pause()

    def _pause(self) -> None:
        if self._controller.fault is not None:
            self._stopping.wait(_RECONNECT_EVERY_S)
            return
        now_s = time.monotonic()
        due_s = min((source.due_s for source in self._sources), default=now_s + _LOOK_S)
        if self._instrument.changed.wait(min(_LOOK_S, max(0.0, due_s - now_s))):
            self._instrument.changed.clear()
            for source in self._sources:  # a faster rate counts at once
                source.due_s = min(source.due_s, now_s + 1 / self._instrument.rate_hz(source.name))

    def _heed(self, mode: Mode) -> None:
        """At a Stop, a hold or a fault, have what moves stay where it is."""
        held, self._held = self._held, mode in _BUSY
        if self._held and not held:
            self._instrument.hold()

    def _take(self, source: _Source, now_s: float) -> None:
        """Read one source. What was missed is not made up for."""
        period_s = 1 / self._instrument.rate_hz(source.name)
        source.due_s += period_s
        if source.due_s < now_s:
            source.due_s = now_s + period_s
        if source.film and self._camera is not None:
            self._shoot(source, self._camera)
            return
        values = self._instrument.read(source.name)
        if not values:
            return
        self._instrument.vigil.note(source.name, values)
        source.sequence += 1
        told = dict(list(values.items())[:MAX_VALUES])
        self._tell(source.name, Measurements(tick_ms=tick_ms(), at_ms=wall_ms(), sequence=source.sequence, values=told))

    def _shoot(self, source: _Source, camera: Camera) -> None:
        taken = camera.frame(source.name)
        if taken is None:
            return
        self._instrument.vigil.note(source.name, taken.content)
        source.sequence += 1
        tick = round(taken.taken_s * 1000)
        try:
            self._film(source.name, CameraFrame(source.sequence, tick, taken.width, taken.height, taken.content))
        except ProtocolError as error:
            raise SensorError(f"{source.name}: {error}; have it take smaller pictures") from error

    def _failed(self, message: str) -> None:
        _log.error("%s: %s", self._name, message)
        self._controller.fail(message)
        with contextlib.suppress(SensorError):
            self._heed(self._controller.step(time.monotonic()).mode)
