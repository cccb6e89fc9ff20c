"""Room driver of a camera; the sources differ only in how frames arrive."""

import threading
from typing import NoReturn

from device_agent.ports.sensor import Capture, Frame, SensorError, Values
from device_agent.protocol import camera_frames
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.camera.options import Timing
from device_agent.sensors.camera.reader import CameraReader, FrameSource
from device_agent.sensors.frames import check_kinds

_EARLY = 0.9
"""A frame may follow this share of a period after the previous one, as cameras do not keep their rate exactly."""
_CONNECT_S = 5.0
"""Wait for the first frame [s]; less than the time after which the agent regards a sensor loop as hanging."""


class CameraDriver:
    """One colour camera: frames on its camera stream, and the capture ``image``, a JPEG.

    Args:
        device: The device; it has exactly one camera stream.
        source: The camera.
        timing: Rate and maximum age of frames.

    Raises:
        SensorError: The device has streams or controls, or not exactly one colour camera.
    """

    def __init__(self, device: RoomDeviceManifest, source: FrameSource, timing: Timing) -> None:
        if len(device.cameras) != 1 or device.streams or device.controls or set(device.captures) - {"image"}:
            raise SensorError(
                f"'{device.name}': driver '{device.driver}' has one camera in `cameras`, and only 'image' in "
                "`captures`; remove other streams, captures and controls"
            )
        check_kinds(device, (camera_frames.COLOUR,))
        self._device = device
        self._source = source
        self._timing = timing
        self._reader: CameraReader | None = None
        self._life = threading.Lock()
        self._returned_s = 0.0

    @property
    def simulated(self) -> bool:
        """Always False."""
        return False

    def connect(self) -> None:
        """See ``RoomDriver``. The reader connects again on its own; this waits for its next frame."""
        with self._life:
            if self._reader is None:
                self._reader = CameraReader(self._source, device=self._device.name, stale_s=self._timing.stale_s)
                self._reader.start()
            reader = self._reader
        reader.wait(_CONNECT_S)

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``. A camera has no streams."""
        self._reject_unknown("stream", stream, [])

    def set(self, control: str, value: float) -> float:  # noqa: ARG002 (the port's signature)
        """See ``RoomDriver``. A camera has no controls."""
        self._reject_unknown("control", control, [])

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self._device.captures:
            self._reject_unknown("capture", name, list(self._device.captures))
        return Capture("image/jpeg", self._newest().content)

    def frame(self, camera: str) -> Frame | None:
        """See ``ports.sensor.Camera``. Each frame is returned once, and at most ``rate_hz`` a second."""
        known = [stream.name for stream in self._device.cameras]
        if camera not in known:
            self._reject_unknown("camera", camera, known)
        newest = self._newest()
        if newest.taken_s - self._returned_s < _EARLY / self._timing.rate_hz:
            return None
        self._returned_s = newest.taken_s
        return newest

    def raw(self) -> None:
        """See ``RoomDriver``. The place of the camera is not calibrated, so perception receives no images."""

    def close(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            reader, self._reader = self._reader, None
            self._returned_s = 0.0
        if reader is not None:
            reader.close()

    def _newest(self) -> Frame:
        reader = self._reader
        if reader is None:
            raise SensorError(f"'{self._device.name}' is not connected")
        return reader.frame()

    def _reject_unknown(self, label: str, name: str, known: list[str]) -> NoReturn:
        raise SensorError(f"'{self._device.name}' has no {label} '{name}'; available: {', '.join(known) or 'none'}")
