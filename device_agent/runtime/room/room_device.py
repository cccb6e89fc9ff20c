"""A room device as its loop and its actions meet it: what it has, how often it is read, what may be asked of it."""

import math
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from device_agent.ports.clock import wall_ms
from device_agent.ports.sensor import Camera, Capture, Movable, RoomDriver, SensorError, Values
from device_agent.ports.uploads import UploadError, Uploads
from device_agent.protocol.commands import CaptureRaw, CollectData, SetControl, TakePicture
from device_agent.protocol.manifests.room import Control, RoomDeviceManifest
from device_agent.runtime.errors import Refused
from device_agent.runtime.room.stream_watchdog import StreamWatchdog

_SUFFIXES = {"image/png": "png", "image/jpeg": "jpg", "application/json": "json"}
_LEAST_RATE_HZ = 0.001


class RoomDevice:
    """One room device. Thread-safe as far as its driver is.

    Args:
        driver: Not yet connected.
        manifest: What it has.
        uploads: Where its captures go; ``None`` where the agent has no such place.

    Attributes:
        driver: As given; the loop connects it.
        manifest: As given.
        streams: Names of what it measures; ``cameras``: of what it films.
        vigil: Over streams and cameras that are silent or stuck; the loop tells it what they gave.
        changed: Set whenever a rate has changed; whoever heeds it clears it.
    """

    def __init__(self, driver: RoomDriver, manifest: RoomDeviceManifest, uploads: Uploads | None) -> None:
        self.driver = driver
        self.manifest = manifest
        self._uploads = uploads
        self._gathering: Mapping[str, float] = {}
        self._counts: Counter[str] = Counter()
        self.vigil = StreamWatchdog(manifest.watch, self.rate_hz)
        self.changed = threading.Event()
        self.streams = tuple(stream.name for stream in manifest.streams)
        self.cameras = tuple(camera.name for camera in manifest.cameras) if isinstance(driver, Camera) else ()

    @property
    def simulated(self) -> bool:
        """Whether it is no real sensor."""
        return self.driver.simulated

    def close(self) -> None:
        """Let the driver go."""
        self.driver.close()

    @property
    def actions(self) -> tuple[str, ...]:
        """The kinds of action that it takes."""
        takes = (
            (CollectData, self.streams),
            (TakePicture, self.streams),
            (CaptureRaw, self.manifest.captures),
            (SetControl, self.manifest.controls),
        )
        return tuple(str(order.__struct_config__.tag) for order, things in takes if things)

    # ------------------------------------------------------------ rates

    def rate_hz(self, name: str) -> float:
        """How often a stream or camera is to be read now [Hz]."""
        asked = self._gathering.get(name)
        if asked is not None:
            return asked
        every = (*self.manifest.streams, *self.manifest.cameras)
        return max(_LEAST_RATE_HZ, next(each.rate_hz for each in every if each.name == name))

    def gather(self, streams: Collection[str], rate_hz: float) -> tuple[str, ...]:
        """Read these streams so often, from now until ``rest``; empty: all.

        Raises:
            Refused: There is no such stream.
        """
        chosen = tuple(self._known(streams))
        self._counts = Counter()
        self._gathering = dict.fromkeys(chosen, rate_hz)
        self.changed.set()
        return chosen

    def rest(self) -> Mapping[str, int]:
        """Read every stream as often as the manifest says; gives how many measurements were gathered of each."""
        self._gathering = {}
        self.changed.set()
        return self._counts

    def _known(self, streams: Collection[str]) -> Iterable[str]:
        if not self.streams:
            raise Refused("no_streams", f"'{self.manifest.name}' has no streams")
        for stream in streams:
            if stream not in self.streams:
                raise Refused("unknown_stream", f"no stream '{stream}'; there are {', '.join(self.streams)}")
        return streams or self.streams

    # ------------------------------------------------------------ what is done with it

    def read(self, stream: str) -> Values:
        """The newest values of one of its streams, but for numbers that are none.

        Raises:
            SensorError: As the driver's ``read``.
        """
        values = {name: value for name, value in self.driver.read(stream).items() if math.isfinite(value)}
        if values and stream in self._gathering:
            self._counts[stream] += 1
        return values

    def shoot(self, streams: Collection[str]) -> dict[str, dict[str, float | bool]]:
        """One measurement now, of these streams or of all.

        Raises:
            Refused: There is no such stream, or the device does not answer.
        """
        try:
            return {stream: dict(self.read(stream)) for stream in self._known(streams)}
        except SensorError as error:
            raise Refused("sensor_failed", str(error)) from error

    def set(self, name: str, value: float) -> float:
        """Set a control; gives what was applied.

        Raises:
            Refused: There is no such control, the value is none or beyond its limits, or it failed.
        """
        control = self._control(name)
        if not math.isfinite(value):
            raise Refused("not_finite", f"{name} must be a finite number")
        if not control.lower <= value <= control.upper:
            limits = f"{control.lower:g} to {control.upper:g} {control.unit}".rstrip()
            raise Refused("out_of_range", f"{name} can be {limits}, not {value:g}")
        try:
            return self.driver.set(name, value)
        except SensorError as error:
            raise Refused("sensor_failed", str(error)) from error

    def _control(self, name: str) -> Control:
        found = next((each for each in self.manifest.controls if each.name == name), None)
        if found is None:
            known = ", ".join(each.name for each in self.manifest.controls) or "none"
            raise Refused("unknown_control", f"no control '{name}'; there are: {known}")
        return found

    def capture(self, name: str) -> dict[str, object]:
        """Take something raw and store it; gives the upload, as results show it.

        Raises:
            Refused: There is no such capture, it failed, or it could not be stored.
        """
        if name not in self.manifest.captures:
            known = ", ".join(self.manifest.captures) or "none"
            raise Refused("unknown_capture", f"no capture '{name}'; there are: {known}")
        if self._uploads is None:
            raise Refused("no_store", "this agent has nowhere to store captures")
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
        """What moves stays where it is.

        Raises:
            SensorError: It failed.
        """
        if isinstance(self.driver, Movable):
            self.driver.hold()


def _file_name(device: str, capture: str, taken: Capture) -> str:
    stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    return f"{device}-{capture}-{stamp}.{_SUFFIXES.get(taken.media_type, 'bin')}"
