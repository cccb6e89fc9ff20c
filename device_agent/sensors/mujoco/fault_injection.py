"""Faults injected into a simulated room device from a file on the agent's machine, for tests and demonstrations.

Only users of the agent's machine can inject faults. The file may be missing and is read again when it changes.

```toml
unreachable = true            # does not respond
silent = ["motion"]           # these streams and cameras return nothing
stuck = ["co2", "colour"]     # these repeat their last value
drift = { co2_ppm = 50.0 }    # drift of a value per minute
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
    """Faults of one room device.

    Attributes:
        unreachable: The device does not respond.
        silent: Streams and cameras that return nothing.
        stuck: Streams and cameras that repeat their last value.
        drift: Value → drift [its unit/min], from when the file is read.
    """

    unreachable: bool = False
    silent: tuple[str, ...] = ()
    stuck: tuple[str, ...] = ()
    drift: dict[str, float] = {}


NO_FAULTS = InjectedFaults()


def read(text: str, sources: Sequence[str]) -> InjectedFaults:
    """Parse a fault file.

    Args:
        text: Content of the file.
        sources: Names of the device's streams and cameras.

    Raises:
        ProtocolError: Not TOML, or an unknown field, stream or camera; the message lists the valid ones.
    """
    faults = fault_file.read(text, InjectedFaults)
    for name in (*faults.silent, *faults.stuck):
        if name not in sources:
            raise ProtocolError(f"no stream or camera '{name}'; valid names: {', '.join(sources)}")
    return faults


class FaultySensor:
    """Wraps a room driver and applies the faults of a file; without the file it is transparent.

    Args:
        driver: The device's driver.
        device: Its entry in the room's manifest.
        path: The fault file; may be missing.
    """

    def __init__(self, driver: RoomDriver, device: RoomDeviceManifest, path: Path) -> None:
        self._driver = driver
        self._name = device.name
        sources = [stream.name for stream in (*device.streams, *device.cameras)]
        self._file = fault_file.FaultFile(path, partial(read, sources=sources))
        self._faults, self._since_s = NO_FAULTS, 0.0
        self._last_values: dict[str, Values] = {}
        self._last_raw: Scan | Image | None = None

    # ------------------------------------------------------------ RoomDriver

    @property
    def simulated(self) -> bool:
        """See ``RoomDriver``."""
        return self._driver.simulated

    def connect(self) -> None:
        """See ``RoomDriver``."""
        self.current_faults()
        self._driver.connect()

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        faults = self.current_faults()
        values = self._driver.read(stream)  # also reports errors of a silent device
        if stream in faults.silent:
            return {}
        if stream in faults.stuck:
            return self._last_values.setdefault(stream, values)
        minutes = (time.monotonic() - self._since_s) / _MINUTE_S
        drifted = {name: values[name] + rate * minutes for name, rate in faults.drift.items() if name in values}
        self._last_values[stream] = values = {**values, **drifted}
        return values

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        self.current_faults()
        return self._driver.capture(name)

    def set(self, control: str, value: float) -> float:
        """See ``RoomDriver``."""
        self.current_faults()
        return self._driver.set(control, value)

    def raw(self) -> Scan | Image | None:
        """See ``RoomDriver``."""
        faults = self.current_faults()
        if faults.silent:
            raise SensorError(f"'{self._name}' returns no data; check its power and connection")
        current = self._driver.raw()
        if current is None or not faults.stuck or self._last_raw is None:
            self._last_raw = current
            return current
        return replace(self._last_raw, taken_s=current.taken_s)

    def hold(self) -> None:
        """See ``ports.sensor.Movable``; an unreachable device receives it, too."""
        if isinstance(self._driver, Movable):
            self._driver.hold()

    def close(self) -> None:
        """See ``RoomDriver``."""
        self._driver.close()

    def current_faults(self) -> InjectedFaults:
        """The current faults.

        Raises:
            SensorError: The device is unreachable.
        """
        changed = self._file.poll()
        if changed is not None:
            self._faults, self._since_s = changed, time.monotonic()
            if changed != NO_FAULTS:
                _log.warning("%s: injected faults are now %s", self._name, changed)
        if self._faults.unreachable:
            raise SensorError(f"'{self._name}' does not respond; check its power and connection")
        return self._faults


class FaultyCamera(FaultySensor):
    """``FaultySensor`` for a camera."""

    def __init__(self, driver: Camera, device: RoomDeviceManifest, path: Path) -> None:
        super().__init__(driver, device, path)
        self._camera = driver
        self._last_frames: dict[str, Frame] = {}

    def frame(self, camera: str) -> Frame | None:
        """See ``ports.sensor.Camera``."""
        faults = self.current_faults()
        current = self._camera.frame(camera)
        if current is None or camera in faults.silent:
            return None
        if camera not in faults.stuck:
            self._last_frames[camera] = current
        # A stuck camera still reports current timestamps.
        return replace(self._last_frames.setdefault(camera, current), taken_s=current.taken_s)


def with_faults(driver: RoomDriver, device: RoomDeviceManifest, path: Path) -> FaultySensor:
    """The driver, wrapped for fault injection."""
    return FaultyCamera(driver, device, path) if isinstance(driver, Camera) else FaultySensor(driver, device, path)
