"""Faults put into a simulated room device on purpose, for tests and demonstrations: from a file beside the agent.

As for robots: only who may write on the agent's own machine can make a device ill, and the file is read again whenever
it has changed. It need not be there.

```toml
unreachable = true            # does not answer at all
silent = ["motion"]           # these streams and cameras give nothing more
stuck = ["co2", "colour"]     # these give what they gave last, on and on
drift = { co2_ppm = 50.0 }    # and this value moves away from the truth, by so much a minute
```
"""

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from msgspec import Struct

from device_agent.ports.sensor import Camera, Capture, Frame, Image, Movable, RoomDriver, Scan, SensorError, Values
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.simulation import fault_file

_MINUTE_S = 60.0
_log = logging.getLogger(__name__)


class InjectedFaults(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a room device suffers from.

    Attributes:
        unreachable: It does not answer.
        silent: Streams and cameras that give nothing.
        stuck: Streams and cameras that give what they gave last.
        drift: Value → how much it moves away from the truth [its unit/min], from when the file is read.
    """

    unreachable: bool = False
    silent: tuple[str, ...] = ()
    stuck: tuple[str, ...] = ()
    drift: dict[str, float] = {}


WELL = InjectedFaults()


def read(text: str, sources: Sequence[str]) -> InjectedFaults:
    """Read a file's text.

    Args:
        text: Of the file.
        sources: Names of the device's streams and cameras.

    Raises:
        ProtocolError: Not TOML, or a field, stream or camera is unknown; the text lists those there are.
    """
    ailments = fault_file.read(text, InjectedFaults)
    for name in (*ailments.silent, *ailments.stuck):
        if name not in sources:
            raise ProtocolError(f"no stream or camera '{name}'; there are: {', '.join(sources)}")
    return ailments


class FaultySensor:
    """A room driver with what ails it; without a file it does as it always does.

    Args:
        driver: Of the device.
        device: Its entry in the room's manifest.
        path: Where the file may be.
    """

    def __init__(self, driver: RoomDriver, device: RoomDeviceManifest, path: Path) -> None:
        self._driver = driver
        self._name = device.name
        sources = [stream.name for stream in (*device.streams, *device.cameras)]
        self._file = fault_file.FaultFile(path, partial(read, sources=sources))
        self._ailments, self._since_s = WELL, 0.0
        self._told: dict[str, Values] = {}
        self._seen: Scan | Image | None = None

    # ------------------------------------------------------------ RoomDriver

    @property
    def simulated(self) -> bool:
        """See ``RoomDriver``."""
        return self._driver.simulated

    def connect(self) -> None:
        """See ``RoomDriver``."""
        self.look()
        self._driver.connect()

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        ailments = self.look()
        values = self._driver.read(stream)  # also a silent one says what it has not, and that it is not connected
        if stream in ailments.silent:
            return {}
        if stream in ailments.stuck:
            return self._told.setdefault(stream, values)
        minutes = (time.monotonic() - self._since_s) / _MINUTE_S
        drifted = {name: values[name] + rate * minutes for name, rate in ailments.drift.items() if name in values}
        self._told[stream] = values = {**values, **drifted}
        return values

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        self.look()
        return self._driver.capture(name)

    def set(self, control: str, value: float) -> float:
        """See ``RoomDriver``."""
        self.look()
        return self._driver.set(control, value)

    def raw(self) -> Scan | Image | None:
        """See ``RoomDriver``."""
        ailments = self.look()
        if ailments.silent:
            raise SensorError(f"'{self._name}' gives nothing; see that it has power and is connected")
        taken = self._driver.raw()
        if taken is None or not ailments.stuck or self._seen is None:
            self._seen = taken
            return taken
        return replace(self._seen, taken_s=taken.taken_s)

    def hold(self) -> None:
        """See ``ports.sensor.Movable``: also what does not answer is told to."""
        if isinstance(self._driver, Movable):
            self._driver.hold()

    def close(self) -> None:
        """See ``RoomDriver``."""
        self._driver.close()

    def look(self) -> InjectedFaults:
        """What ails it now.

        Raises:
            SensorError: It does not answer.
        """
        news = self._file.news()
        if news is not None:
            self._ailments, self._since_s = news, time.monotonic()
            if news != WELL:
                _log.warning("%s now suffers from %s", self._name, news)
        if self._ailments.unreachable:
            raise SensorError(f"'{self._name}' does not answer; see that it has power and is connected")
        return self._ailments


class CameraPatient(FaultySensor):
    """The same with a camera."""

    def __init__(self, driver: Camera, device: RoomDeviceManifest, path: Path) -> None:
        super().__init__(driver, device, path)
        self._camera = driver
        self._pictures: dict[str, Frame] = {}

    def frame(self, camera: str) -> Frame | None:
        """See ``ports.sensor.Camera``."""
        ailments = self.look()
        taken = self._camera.frame(camera)
        if taken is None or camera in ailments.silent:
            return None
        if camera not in ailments.stuck:
            self._pictures[camera] = taken
        # What is stuck does not know it: it says that each of its pictures is new.
        return replace(self._pictures.setdefault(camera, taken), taken_s=taken.taken_s)


def patient(driver: RoomDriver, device: RoomDeviceManifest, path: Path) -> FaultySensor:
    """The driver, with what the file may put into it."""
    return CameraPatient(driver, device, path) if isinstance(driver, Camera) else FaultySensor(driver, device, path)
