"""Base class of room drivers whose streams and controls are mapped to a device by options of ``agent.toml``."""

import threading
from collections.abc import Collection, Mapping
from typing import NoReturn, TypeVar

import msgspec

from device_agent.ports.sensor import Capture, Image, Scan, SensorError, Values
from device_agent.protocol.manifests.room import RoomDeviceManifest

SETTINGS = "settings"
"""Optional stream of a device with controls: the values that the device reports for them."""
Options = TypeVar("Options")


def parse_options(device: RoomDeviceManifest, kind: type[Options]) -> Options:
    """The options of a device as ``kind``, a msgspec structure.

    Raises:
        SensorError: An option is unknown, missing or wrong; the message names it.
    """
    known = [field.name for field in msgspec.structs.fields(kind)]  # type: ignore[arg-type]
    for name in device.options:
        if name not in known:
            raise SensorError(
                f"driver '{device.driver}' of '{device.name}' has no option '{name}'; it has: {', '.join(known)}"
            )
    try:
        return msgspec.convert(device.options, kind)
    except msgspec.ValidationError as error:
        raise SensorError(f"options of '{device.name}': {error}") from error


class ConfiguredDevice:
    """Names of a configured device, and the calls that no such device supports.

    Args:
        device: The device.
        streams: Stream → mapped quantities, from the options.
        controls: Mapped controls, from the options.

    Raises:
        SensorError: A stream or control of the device is not mapped, or a mapped one does not exist.
    """

    def __init__(
        self, device: RoomDeviceManifest, *, streams: Mapping[str, Collection[str]], controls: Collection[str]
    ) -> None:
        self.device = device
        own = [stream.name for stream in device.streams]
        implied = {SETTINGS} if controls and SETTINGS in own and SETTINGS not in streams else set()
        self._check_names("streams", own, {*streams, *implied})
        self._check_names("controls", [control.name for control in device.controls], controls)
        if device.cameras or device.captures:
            raise SensorError(f"driver '{device.driver}' of '{device.name}' has no cameras and captures; remove them")
        for stream, quantities in streams.items():
            if not quantities:
                raise SensorError(f"option 'streams.{stream}' of '{device.name}' maps no quantity")

    @property
    def simulated(self) -> bool:
        """Always False."""
        return False

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        self.reject_unknown("capture", name, ())

    def raw(self) -> Scan | Image | None:
        """See ``RoomDriver``."""
        return None

    def reject_unknown(self, label: str, name: str, known: Collection[str]) -> NoReturn:
        """Reject an unknown name.

        Raises:
            SensorError: Always; the message lists the known names.
        """
        raise SensorError(f"'{self.device.name}' has no {label} '{name[:80]}'; it has: {', '.join(known) or 'none'}")

    def not_connected(self) -> SensorError:
        """The error of a call that needs a connection."""
        return SensorError(f"'{self.device.name}' is not connected")

    def _check_names(self, label: str, own: Collection[str], mapped: Collection[str]) -> None:
        for name in own:
            if name not in mapped:
                raise SensorError(f"'{self.device.name}' has no option '{label}.{name}', which maps it to the device")
        for name in mapped:
            if name not in own:
                known = ", ".join(own) or "none"
                raise SensorError(f"option '{label}.{name}' of '{self.device.name}': no such entry; it has: {known}")


class SampleInbox:
    """The newest sample of each stream of a device that sends by itself. Thread-safe.

    Each sample is taken once, so that an old value is never reported as a new measurement. An unusable message is a
    fault of its streams until a usable one of the same kind arrives.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._samples: dict[str, Values] = {}
        self._problems: dict[tuple[str, str], str] = {}

    def put(self, stream: str, values: Values, kind: str = "") -> None:
        """Add values to the newest sample; ends the fault of the stream by this kind of message."""
        with self._lock:
            self._problems.pop((stream, kind), None)
            self._samples[stream] = {**self._samples.get(stream, {}), **values}

    def fail(self, stream: str, problem: str, kind: str = "") -> None:
        """Report a message that is not usable."""
        with self._lock:
            self._samples.pop(stream, None)
            self._problems[stream, kind] = problem

    def take(self, stream: str) -> Values:
        """The sample that has arrived since the last call; empty if there is none.

        Raises:
            SensorError: The newest message of a kind is not usable.
        """
        with self._lock:
            for (failed, _), problem in self._problems.items():
                if failed == stream:
                    raise SensorError(problem)
            return self._samples.pop(stream, {})

    def check(self) -> None:
        """Raise the fault of a stream.

        Raises:
            SensorError: The newest message of a stream is not usable.
        """
        with self._lock:
            for problem in self._problems.values():
                raise SensorError(problem)

    def clear(self) -> None:
        """Forget all samples and faults, as after a new connection."""
        with self._lock:
            self._samples.clear()
            self._problems.clear()
