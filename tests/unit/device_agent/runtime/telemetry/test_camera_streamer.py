"""Camera streaming: rates, control, link and errors."""

from collections.abc import Callable

import pytest

from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Frame
from device_agent.protocol import CameraStream, Description, camera_frames, topics
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.telemetry.camera_streamer import LINGER_S, CameraStreamer, FrameRecording
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import eventually
from tests.harness.agent.load import raise_level
from tests.unit.device_agent.runtime.conftest import MakeDevice
from tests.unit.device_agent.runtime.telemetry.conftest import PollClock

EYES = CameraStream(name="eyes", rate_hz=100.0)
JPEG = b"\xff\xd8 a picture"


class CameraDriver(FakeDriver):
    """A driver with preset pictures."""

    def __init__(self, picture: Callable[[], bytes | None] = lambda: JPEG) -> None:
        super().__init__()
        self._picture = picture
        self.reads = 0

    def frame(self, camera: str) -> Frame | None:
        assert camera == "eyes"
        self.reads += 1
        content = self._picture()
        return None if content is None else Frame(4, 3, content, taken_s=1.0)


class StreamerFixture:
    """A streamer with a link, during control."""

    def __init__(self, driver: CameraDriver | None, recording: FrameRecording | None = None) -> None:
        self.frames: list[CameraFrame] = []
        self.controlled = True
        self.load = LoadGovernor()
        self.streamer = CameraStreamer(
            [EYES],
            driver,
            name="cart",
            publish=self.publish,
            is_controlled=lambda: self.controlled,
            load=self.load,
            recording=recording,
        )
        self.streamer.link_changed(True)

    def publish(self, _: str, frame: CameraFrame) -> None:
        self.frames.append(frame)


def test_a_device_describes_and_streams_its_cameras(make_device: MakeDevice) -> None:
    harness = make_device(kind=robot_type(cameras=(EYES,)), driver=CameraDriver())
    described: Description = eventually(lambda: harness.published(topics.DESC, Description))[0]
    assert described.cameras == (EYES,)
    payload = eventually(lambda: [payload for topic, payload in list(harness.messages) if topic.endswith("/cam/eyes")])[
        0
    ]
    first = camera_frames.decode(payload)
    assert (first.sequence, first.width, first.height, first.content) == (1, 4, 3, JPEG)


def test_frames_are_numbered_and_missing_ones_are_skipped(clock: PollClock) -> None:
    pictures = iter([JPEG, None, JPEG])
    fixture = StreamerFixture(CameraDriver(lambda: next(pictures, None)))
    clock.run(fixture.streamer, 1.0)
    assert [frame.sequence for frame in fixture.frames] == [1, 2]


def test_a_camera_error_is_logged_once_with_advice(clock: PollClock, caplog: pytest.LogCaptureFixture) -> None:
    covered = True

    def picture() -> bytes:
        if covered:
            raise DriverError("the lens is covered")
        return JPEG

    def reject(_: str, frame: CameraFrame) -> None:
        raise ProtocolError(f"a picture of {len(frame.content)} bytes")

    fixture = StreamerFixture(CameraDriver(picture))
    fixture.streamer._publish = reject
    clock.run(fixture.streamer, 1.0)
    covered = False
    clock.run(fixture.streamer, 1.0)
    assert [record.getMessage() for record in caplog.records] == [
        "cart: camera eyes: the lens is covered",
        f"cart: camera eyes: a picture of {len(JPEG)} bytes; configure smaller pictures",
    ]


def test_without_cameras_there_are_no_frames() -> None:
    fixture = StreamerFixture(None)
    fixture.streamer.start()
    fixture.streamer.stop()
    assert fixture.frames == []


def test_frames_are_live_with_a_link_during_control_and_for_a_while_after(clock: PollClock) -> None:
    driver = CameraDriver()
    fixture = StreamerFixture(driver)

    def frames_in(seconds: float) -> int:
        before = len(fixture.frames)
        clock.run(fixture.streamer, seconds)
        return len(fixture.frames) - before

    fixture.controlled = False
    assert 10 <= frames_in(10.0) <= 11
    fixture.controlled = True
    assert 990 <= frames_in(10.0) <= 1001
    fixture.controlled = False
    assert 990 <= frames_in(10.0) <= 1001
    clock.run(fixture.streamer, LINGER_S)
    assert 10 <= frames_in(10.0) <= 11
    assert driver.reads == len(fixture.frames), "the driver takes no other pictures"
    fixture.controlled = True
    fixture.streamer.link_changed(False)
    assert frames_in(10.0) == 0
    assert driver.reads == len(fixture.frames)


def test_an_overloaded_agent_sends_a_quarter_of_the_frames(clock: PollClock) -> None:
    fixture = StreamerFixture(CameraDriver())
    clock.run(fixture.streamer, 4.0)
    usual = len(fixture.frames)
    raise_level(fixture.load, 1)
    clock.run(fixture.streamer, 4.0)
    assert len(fixture.frames) - usual == pytest.approx(usual / 4, abs=1)


class Recording:
    """Records a frame every half second while it is on."""

    def __init__(self, clock: PollClock) -> None:
        self.on = True
        self.frames: list[Frame] = []
        self._clock = clock
        self._due_s = 0.0

    def is_due(self, camera: str, now_s: float) -> bool:
        assert camera == "eyes"
        return self.on and now_s >= self._due_s

    def record(self, camera: str, picture: Frame) -> None:
        if self.is_due(camera, self._clock.now_s):
            self._due_s = self._clock.now_s + 0.5
            self.frames.append(picture)


def test_frames_are_recorded_without_a_link_and_viewers_at_the_rate_of_the_recording(clock: PollClock) -> None:
    driver, recording = CameraDriver(), Recording(clock)
    fixture = StreamerFixture(driver, recording)
    fixture.controlled = False
    clock.run(fixture.streamer, 10.0)
    assert len(recording.frames) == pytest.approx(20, abs=1)
    assert len(fixture.frames) == pytest.approx(10, abs=1)
    assert driver.reads <= 32, "other pictures are not taken"
    fixture.streamer.link_changed(False)
    sent, before = len(fixture.frames), driver.reads
    clock.run(fixture.streamer, 10.0)
    assert len(fixture.frames) == sent
    assert driver.reads - before == pytest.approx(20, abs=1)
    recording.on = False
    before = driver.reads
    clock.run(fixture.streamer, 10.0)
    assert driver.reads == before
