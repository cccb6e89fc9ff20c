"""A fake sensor and fake uploads, and a harness that runs a room device on them."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.sensor import Capture, Frame, SensorError
from device_agent.ports.uploads import UploadError
from device_agent.protocol import CameraStream, Measurements, Stream, topics
from device_agent.protocol.manifests.room import Control as RoomControl
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.runtime.recording.recorder import Recorder
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.runtime.supervision import Supervisor
from tests.harness.agent.device_harness import DeviceHarness, eventually

JPEG = b"\xff\xd8 a picture \xff\xd9"
ENTRY = RoomDeviceManifest(
    name="arm",  # the device name of the harness
    kind="window",
    label="Window",
    driver="fake",
    streams=(Stream(name="air", rate_hz=20.0), Stream(name="rain", rate_hz=5.0)),
    cameras=(CameraStream(name="garden", rate_hz=20.0),),
    captures=("image",),
    controls=(RoomControl(name="opening", label="Opening", unit="m", lower=0.0, upper=0.5),),
    position_m=(1.0, -2.0, 1.5),
)


class FakeSensor:
    """A sensor that counts its reads."""

    simulated = True

    def __init__(self) -> None:
        self.reads: dict[str, int] = {"air": 0, "rain": 0}
        self.broken = ""
        self.set_to: list[float] = []
        self.holds = 0
        self.closed = False
        self.picture = JPEG
        self.frame_kind = "colour"
        self.values: dict[str, float | bool] = {}

    def connect(self) -> None:
        self._check()

    def read(self, stream: str) -> dict[str, float | bool]:
        self._check()
        self.reads[stream] += 1
        return {"reads": float(self.reads[stream]), **self.values} if stream == "air" else {}

    def frame(self, _camera: str) -> Frame | None:
        self._check()
        return None if not self.picture else Frame(4, 3, self.picture, time.monotonic(), self.frame_kind)

    def capture(self, _name: str) -> Capture:
        self._check()
        return Capture("image/png", b"PNG")

    def set(self, _control: str, value: float) -> float:
        self._check()
        self.set_to.append(value)
        return value / 2

    def hold(self) -> None:
        self._check()
        self.holds += 1

    def raw(self) -> None:
        return None

    def close(self) -> None:
        self.closed = True

    def _check(self) -> None:
        if self.broken:
            raise SensorError(self.broken)


class ReducibleSensor(FakeSensor):
    """A sensor with work of its own."""

    share = 1.0

    def reduce(self, share: float) -> None:
        self.share = share


class FakeUploads:
    """Records the stored uploads."""

    def __init__(self) -> None:
        self.stored: list[dict[str, Any]] = []
        self.full = False

    def store(self, device: str, **more: Any) -> str:
        if self.full:
            raise UploadError("the store is full; delete something")
        self.stored.append({"device": device, **more})
        return "u1"


class RoomDeviceHarness(DeviceHarness):
    def __init__(
        self,
        folder: Path,
        *,
        entry: RoomDeviceManifest = ENTRY,
        uploads: bool = True,
        interlocks: Sequence[InterlockRule] = (),
        broken: str = "",
        sensor: FakeSensor | None = None,
        supervisor: Supervisor | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.sensor, self.uploads = sensor or FakeSensor(), FakeUploads()
        self.sensor.broken = broken
        self.room_device = RoomDevice(self.sensor, entry, self.uploads if uploads else None)
        driver: Any = self.room_device
        super().__init__(
            folder,
            driver=driver,
            kind=entry.robot_type(),
            interlocks=interlocks,
            supervisor=supervisor,
            recorder=recorder,
        )
        self.last_epoch = 0

    def command(self, request: Any, *, epoch: int | None = None, **fields: Any) -> str:
        """Send a command with a new epoch, as the cloud does."""
        self.last_epoch += epoch is None
        return super().command(request, epoch=self.last_epoch if epoch is None else epoch, **fields)

    def measured(self, stream: str = "air") -> list[Measurements]:
        return self.published(topics.TELE, Measurements, stream)

    def pictures(self) -> list[bytes]:
        camera = topics.device("s", "a", "arm", topics.CAM, "garden")
        return [payload for topic, payload in self.messages if topic == camera]


def await_growth(items: Callable[[], list[Any]], by: int = 3) -> None:
    before = len(items())
    eventually(lambda: len(items()) >= before + by)
