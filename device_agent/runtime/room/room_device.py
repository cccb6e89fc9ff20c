"""Room device: streams, rates and actions of one sensor."""

import math
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from device_agent.ports.clock import wall_ms
from device_agent.ports.sensor import Camera, Capture, Movable, RoomDriver, SensorError, Values
from device_agent.ports.uploads import UploadError, Uploads
from device_agent.protocol.commands import CaptureRaw, CollectData, SetControl, TakePicture
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.runtime.errors import Refused
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.room.controls import check_value
from device_agent.runtime.room.stream_watchdog import StreamWatchdog

_SUFFIXES = {"image/png": "png", "image/jpeg": "jpg", "application/json": "json"}
_MIN_RATE_HZ = 0.001


class RoomDevice:
    """One room device. As thread-safe as its driver.

    Attributes:
        driver: Driver; the sensor loop connects it.
        manifest: Manifest of the device.
        streams: Names of the streams.
        cameras: Names of the cameras.
        load: Reduces rates on an overloaded machine; the device replaces it by the agent's.
        watchdog: Detects silent or stuck streams and cameras.
        rates_changed: Set when a rate has changed; the sensor loop clears it.
    """

    def __init__(self, driver: RoomDriver, manifest: RoomDeviceManifest, uploads: Uploads | None) -> None:
        self.driver = driver
        self.manifest = manifest
        self._uploads = uploads
        self.load = LoadGovernor()
        self._collecting: Mapping[str, float] = {}
        self._counts: Counter[str] = Counter()
        self.watchdog = StreamWatchdog(manifest.watch, self.rate_hz)
        self.rates_changed = threading.Event()
        self.streams = tuple(stream.name for stream in manifest.streams)
        self.cameras = tuple(camera.name for camera in manifest.cameras) if isinstance(driver, Camera) else ()

    @property
    def simulated(self) -> bool:
        """Whether the sensor is simulated."""
        return self.driver.simulated

    def close(self) -> None:
        """Close the driver."""
        self.driver.close()

    @property
    def actions(self) -> tuple[str, ...]:
        """Kinds of the supported actions."""
        supported = (
            (CollectData, self.streams),
            (TakePicture, self.streams),
            (CaptureRaw, self.manifest.captures),
            (SetControl, self.manifest.controls),
        )
        return tuple(str(task.__struct_config__.tag) for task, items in supported if items)

    # ------------------------------------------------------------ rates

    def rate_hz(self, name: str) -> float:
        """Present rate of a stream or camera [Hz]."""
        rate_hz = self._collecting.get(name)
        if rate_hz is not None:
            return rate_hz
        sources = (*self.manifest.streams, *self.manifest.cameras)
        share = self.load.share("cameras" if name in self.cameras else "telemetry")
        return max(_MIN_RATE_HZ, share * next(source.rate_hz for source in sources if source.name == name))

    def collect(self, streams: Collection[str], rate_hz: float) -> tuple[str, ...]:
        """Read these streams, or all if none is named, at a rate until ``idle``; returns their names.

        Raises:
            Refused: A stream is unknown.
        """
        chosen = tuple(self._resolve_streams(streams))
        self._counts = Counter()
        self._collecting = dict.fromkeys(chosen, rate_hz)
        self.rates_changed.set()
        return chosen

    def idle(self) -> Mapping[str, int]:
        """Return to the manifest's rates; returns the number of collected measurements of each stream."""
        self._collecting = {}
        self.rates_changed.set()
        return self._counts

    def _resolve_streams(self, streams: Collection[str]) -> Iterable[str]:
        if not self.streams:
            raise Refused("no_streams", f"'{self.manifest.name}' has no streams")
        for stream in streams:
            if stream not in self.streams:
                raise Refused("unknown_stream", f"no stream '{stream}'; there are {', '.join(self.streams)}")
        return streams or self.streams

    # ------------------------------------------------------------ operations

    def read(self, stream: str) -> Values:
        """The newest finite values of a stream.

        Raises:
            SensorError: As the driver's ``read``.
        """
        values = {name: value for name, value in self.driver.read(stream).items() if math.isfinite(value)}
        if values and stream in self._collecting:
            self._counts[stream] += 1
        return values

    def take_picture(self, streams: Collection[str]) -> dict[str, dict[str, float | bool]]:
        """Measure these streams, or all if none is named, once.

        Raises:
            Refused: A stream is unknown, or the device does not respond.
        """
        try:
            return {stream: dict(self.read(stream)) for stream in self._resolve_streams(streams)}
        except SensorError as error:
            raise Refused("sensor_failed", str(error)) from error

    def set(self, name: str, value: float) -> float:
        """Set a control; returns the applied value.

        Raises:
            Refused: Unknown control, value not finite or out of range, or the device failed.
        """
        check_value(self.manifest.controls, name, value)
        try:
            return self.driver.set(name, value)
        except SensorError as error:
            raise Refused("sensor_failed", str(error)) from error

    def capture_raw(self, name: str) -> dict[str, object]:
        """Capture raw data and upload it; returns the upload for the result.

        Raises:
            Refused: Unknown capture, the device failed, or the upload failed.
        """
        if name not in self.manifest.captures:
            names = ", ".join(self.manifest.captures) or "none"
            raise Refused("unknown_capture", f"no capture '{name}'; there are: {names}")
        if self._uploads is None:
            raise Refused("no_store", "this agent has no storage for captures")
        try:
            at_ms, taken = wall_ms(), self.driver.capture(name)
            upload = self._uploads.store(
                self.manifest.name,
                stream=name,
                name=_file_name(self.manifest.name, name, taken),
                media_type=taken.media_type,
                content=taken.content,
                at_ms=at_ms,
            )
        except SensorError as error:
            raise Refused("sensor_failed", str(error)) from error
        except UploadError as error:
            raise Refused("not_stored", str(error)) from error
        return {"upload": upload, "media_type": taken.media_type, "length": len(taken.content)}

    def hold(self) -> None:
        """Hold the position of moving parts.

        Raises:
            SensorError: The device failed.
        """
        if isinstance(self.driver, Movable):
            self.driver.hold()


def _file_name(device: str, capture: str, taken: Capture) -> str:
    stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    return f"{device}-{capture}-{stamp}.{_SUFFIXES.get(taken.media_type, 'bin')}"
