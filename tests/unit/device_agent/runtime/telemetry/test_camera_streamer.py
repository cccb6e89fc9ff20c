"""Camera streaming: rates, control, link and errors."""

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Frame
from device_agent.protocol import Description, Stream, camera_frames, topics
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.telemetry.camera_streamer import CameraStreamer
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually

EYES = Stream(name="eyes", rate_hz=100.0)
JPEG = b"\xff\xd8 a picture"


class Seeing(FakeDriver):
    """A driver with preset pictures."""

    def __init__(self, see: Callable[[], bytes | None]) -> None:
        super().__init__()
        self._see = see
        self.asked = 0

    def frame(self, camera: str) -> Frame | None:
        assert camera == "eyes"
        self.asked += 1
        content = self._see()
        return None if content is None else Frame(4, 3, content, time.monotonic())


def watched(
    driver: Seeing | None,
    film: Callable[[str, CameraFrame], None],
    *,
    controlled: Callable[[], bool] = lambda: True,
    linger_s: float = 60.0,
) -> CameraStreamer:
    """A filmer at work, with a link."""
    filmer = CameraStreamer([EYES], driver, name="cart", publish=film, is_controlled=controlled, linger_s=linger_s)
    filmer.link_changed(True)
    filmer.start()
    return filmer


def test_a_device_describes_and_streams_its_cameras(tmp_path: Path) -> None:
    kind = msgspec.structs.replace(robot_type(), cameras=(EYES,))
    harness = DeviceHarness(tmp_path, kind=kind, driver=Seeing(lambda: JPEG))
    harness.start()
    (described,) = eventually(lambda: harness.heard(topics.DESC, Description))[:1]
    shown = eventually(lambda: [payload for topic, payload in list(harness.said) if topic.endswith("/cam/eyes")][:3])
    harness.stop()
    assert described.cameras == (EYES,)
    first = camera_frames.decode(shown[0])
    assert (first.sequence, first.width, first.height, first.jpeg) == (1, 4, 3, JPEG)


def test_frames_are_numbered_and_missing_ones_are_skipped() -> None:
    given = iter([JPEG, None, JPEG])
    driver, told = Seeing(lambda: next(given, None)), list[CameraFrame]()
    filmer = watched(driver, lambda _, frame: told.append(frame))
    eventually(lambda: driver.asked > 4)
    filmer.stop()
    filmer.stop()
    assert [frame.sequence for frame in told] == [1, 2]


def test_a_camera_error_is_logged_once_with_advice(caplog: pytest.LogCaptureFixture) -> None:
    well, told = threading.Event(), threading.Event()

    def dark() -> bytes:
        if well.is_set():
            return JPEG
        raise DriverError("the lens is covered")

    def large(_: str, frame: CameraFrame) -> None:
        told.set()
        raise ProtocolError(f"a picture of {len(frame.jpeg)} bytes")

    driver = Seeing(dark)
    with caplog.at_level(logging.WARNING):
        filmer = watched(driver, large)
        eventually(lambda: driver.asked > 3)
        well.set()
        assert told.wait(15)
        seen = driver.asked
        eventually(lambda: driver.asked > seen + 2)
        filmer.stop()
    texts = [record.getMessage() for record in caplog.records]
    assert texts == [
        "cart: camera eyes: the lens is covered",
        f"cart: camera eyes: a picture of {len(JPEG)} bytes; configure smaller pictures",
    ]


def test_without_cameras_there_are_no_frames() -> None:
    told = list[CameraFrame]()
    filmer = watched(None, lambda _, frame: told.append(frame))
    filmer.stop()
    assert told == []


def paced(pictures: list[CameraFrame], count: int) -> float:
    """How long it takes from the first to the last of so many more pictures [s]."""
    first = len(pictures)
    eventually(lambda: len(pictures) > first)
    start_s = time.monotonic()
    eventually(lambda: len(pictures) > first + count)
    return time.monotonic() - start_s


def test_frames_are_slow_without_control_and_live_during_control() -> None:
    told, controlled = list[CameraFrame](), threading.Event()
    driver = Seeing(lambda: JPEG)
    filmer = watched(driver, lambda _, frame: told.append(frame), controlled=controlled.is_set, linger_s=0.5)
    try:
        assert paced(told, 2) >= 1.9
        assert driver.asked == len(told)  # what is not shown is not drawn either
        controlled.set()
        eventually(lambda: len(told) > 50)
        controlled.clear()
        time.sleep(0.6)
        assert paced(told, 2) >= 1.9
    finally:
        filmer.stop()


def test_frames_stay_live_for_a_while_after_control_ends() -> None:
    told, controlled = list[CameraFrame](), threading.Event()
    controlled.set()
    filmer = watched(
        Seeing(lambda: JPEG), lambda _, frame: told.append(frame), controlled=controlled.is_set, linger_s=60
    )
    eventually(lambda: told)
    controlled.clear()
    seen = len(told)
    start_s = time.monotonic()
    eventually(lambda: len(told) > seen + 20)
    filmer.stop()
    assert time.monotonic() - start_s < 15


def test_without_a_link_there_are_no_frames() -> None:
    driver = Seeing(lambda: JPEG)
    filmer = watched(driver, lambda _, __: None)
    eventually(lambda: driver.asked)
    filmer.link_changed(False)
    time.sleep(0.1)  # one may be under way
    seen = driver.asked
    time.sleep(0.3)
    filmer.stop()
    assert driver.asked == seen
