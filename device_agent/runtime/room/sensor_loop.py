"""Sensor loop of a room device: reads each stream and camera at its rate, and applies Stop, lease and interlocks.

It replaces the control loop of a robot. A slow sensor delays only its own device.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.driver import Observation
from device_agent.ports.sensor import Camera, Frame, Reducible, SensorError
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.protocol import MAX_VALUES, Fault, Measurements, Mode
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import INTERNAL_ERROR
from device_agent.runtime.room.room_device import RoomDevice

_CHECK_PERIOD_S = 0.05
"""Period of the checks for Stop and hold [s]."""
_RECONNECT_PERIOD_S = 1.0
_START_S = 2.0
"""The start of the agent waits at most this time for the first connection of each device [s]."""
_NOT_CONNECTED = "The device has not responded yet."
_HOLD_MODES = frozenset({Mode.STOPPED, Mode.HOLDING, Mode.FAULT})
"""Modes in which the device must not move."""
SENSOR_LOOP = "sensor loop"
_RESPONSE_S = 10.0
"""A loop without progress for this time hangs [s]; a reading or reconnection may take as long as the sensor needs."""
_NO_JOINTS = Observation((), (), (), ())
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Source:
    """A stream or camera: when it is due [s], and the sequence of its newest message."""

    name: str
    is_camera: bool
    due_s: float = 0.0
    sequence: int = 0


class SensorLoop:
    """One thread that reads the sources that are due. Its callbacks must not block; an error of an interlock holds."""

    def __init__(
        self,
        room_device: RoomDevice,
        controller: Controller,
        *,
        name: str,
        publish: Callable[[str, Measurements], None],
        publish_frame: Callable[[str, CameraFrame], None],
        check_interlocks: Callable[[float], None],
        record_frame: Callable[[str, Frame], None] | None = None,
    ) -> None:
        self._driver = room_device.driver
        self._reducible = room_device.driver if isinstance(room_device.driver, Reducible) else None
        self._camera = room_device.driver if isinstance(room_device.driver, Camera) else None
        self._room_device = room_device
        self._controller = controller
        self._name = name
        self._publish = publish
        self._publish_frame = publish_frame
        self._check_interlocks = check_interlocks
        self._record_frame = record_frame
        self._sources = [_Source(stream, is_camera=False) for stream in room_device.streams]
        self._sources += [_Source(camera, is_camera=True) for camera in room_device.cameras]
        self._kinds = {camera.name: camera.kind for camera in room_device.manifest.cameras}
        self._held = False
        self._logged = ""
        self._attempted = threading.Event()
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name=f"{name}-sensing",
            part=SENSOR_LOOP,
            device=name,
            stopping=self._stopping,
            recovery=Recovery.RESTART,
            within_s=_RESPONSE_S,
        )
        self.observation: Observation | None = None

    def start(self) -> None:
        """Start to connect the driver and to read. A missing sensor is a fault; the agent still runs."""
        self.observation = _NO_JOINTS
        self._controller.start_at(())
        self._controller.set_fault(_NOT_CONNECTED)  # not published if the thread clears or replaces it in time
        self._room_device.watchdog.reset()
        self._thread.start()
        self._attempted.wait(_START_S)

    def faults(self) -> tuple[Fault, ...]:
        """Faults of the streams; none while the sensor itself has a fault."""
        return () if self._controller.fault is not None else self._room_device.watchdog.faults()

    def stop(self) -> None:
        """End the thread. May be called twice."""
        self._stopping.set()
        self._room_device.rates_changed.set()
        self._thread.join(timeout=2)

    def fail(self, message: str) -> None:
        """Hold moving parts without the loop, which has ended or hangs. If it responds again, it reconnects."""
        self._controller.set_fault(message)
        self._hold()

    def _hold(self) -> None:
        with contextlib.suppress(SensorError):
            self._room_device.hold()

    def wake(self) -> None:
        """Hold moving parts at a Stop if the loop has ended or hangs. A room device has no setpoints."""
        if self._controller.stop_pending and not self._thread.responsive:
            self._hold()

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._thread.beat()
            now_s = time.monotonic()
            try:
                if self._controller.fault is not None:
                    self._driver.connect()
                    self._room_device.watchdog.reset()
                    self._controller.clear_fault(())
                    self._attempted.set()
                self._check_interlocks(now_s)
                self._apply(self._controller.update(now_s))
                if self._reducible is not None:
                    self._reducible.reduce(self._room_device.load.share("perception"))
                for source in self._sources:
                    if source.due_s <= now_s:
                        self._read(source, now_s)
            except SensorError as error:
                self._set_fault(str(error))
            except Exception as error:  # noqa: BLE001 (any error is reported as a fault)
                if repr(error) != self._logged:
                    _log.exception("%s: sensing", self._name)
                self._logged = repr(error)
                self._set_fault(INTERNAL_ERROR)
            self._pause()

    def _pause(self) -> None:
        if self._controller.fault is not None:
            self._stopping.wait(_RECONNECT_PERIOD_S)
            return
        now_s = time.monotonic()
        due_s = min((source.due_s for source in self._sources), default=now_s + _CHECK_PERIOD_S)
        if self._room_device.rates_changed.wait(min(_CHECK_PERIOD_S, max(0.0, due_s - now_s))):
            self._room_device.rates_changed.clear()
            for source in self._sources:  # a faster rate applies immediately
                source.due_s = min(source.due_s, now_s + 1 / self._room_device.rate_hz(source.name))

    def _apply(self, output: ControlOutput) -> None:
        """Hold moving parts on a Stop, a hold or a fault. A hold that failed is repeated."""
        holds = output.mode in _HOLD_MODES
        if holds and not self._held:
            self._room_device.hold()
        self._held = holds
        self._controller.record_period(output)

    def _read(self, source: _Source, now_s: float) -> None:
        """Read one source. Missed readings are dropped."""
        period_s = 1 / self._room_device.rate_hz(source.name)
        source.due_s += period_s
        if source.due_s < now_s:
            source.due_s = now_s + period_s
        if source.is_camera and self._camera is not None:
            self._read_camera(source, self._camera)
            return
        values = self._room_device.read(source.name)
        if not values:
            return
        self._room_device.watchdog.record(source.name, values)
        source.sequence += 1
        published = dict(list(values.items())[:MAX_VALUES])
        self._publish(
            source.name, Measurements(tick_ms=tick_ms(), at_ms=wall_ms(), sequence=source.sequence, values=published)
        )

    def _read_camera(self, source: _Source, camera: Camera) -> None:
        picture = camera.frame(source.name)
        if picture is None:
            return
        if picture.kind != self._kinds[source.name]:
            raise SensorError(
                f"{source.name}: the manifest declares the kind '{self._kinds[source.name]}', but the driver sends "
                f"'{picture.kind}'; correct the kind"
            )
        self._room_device.watchdog.record(source.name, picture.content)
        if self._record_frame is not None:
            self._record_frame(source.name, picture)
        source.sequence += 1
        tick = round(picture.taken_s * 1000)
        try:
            frame = CameraFrame(source.sequence, tick, picture.width, picture.height, picture.content, picture.kind)
            self._publish_frame(source.name, frame)
        except ProtocolError as error:
            raise SensorError(f"{source.name}: {error}; configure smaller pictures") from error

    def _set_fault(self, message: str) -> None:
        self._controller.set_fault(message)
        self._attempted.set()
        with contextlib.suppress(SensorError):
            self._apply(self._controller.update(time.monotonic()))
