"""What a robot sees: told at its rate, beside what moves it, whatever goes wrong with it."""

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Frame
from device_agent.protocol import frames, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.frames import CameraFrame
from device_agent.protocol.messages import Description, Stream
from device_agent.runtime.filming import Filmer
from tests.support.bench import Bench, eventually
from tests.support.toys import ToyDriver, robot_type

EYES = Stream(name="eyes", rate_hz=100.0)
JPEG = b"\xff\xd8 a picture"


class Seeing(ToyDriver):
    """Sees what it is told to."""

    def __init__(self, see: Callable[[], bytes | None]) -> None:
        super().__init__()
        self._see = see
        self.asked = 0

    def frame(self, camera: str) -> Frame | None:
        assert camera == "eyes"
        self.asked += 1
        content = self._see()
        return None if content is None else Frame(4, 3, content, time.monotonic())


def test_a_device_describes_its_cameras_and_tells_what_they_see(tmp_path: Path) -> None:
    kind = msgspec.structs.replace(robot_type(), cameras=(EYES,))
    bench = Bench(tmp_path, kind=kind, driver=Seeing(lambda: JPEG))
    bench.device.start()
    bench.device.link_changed(True)
    (described,) = eventually(lambda: bench.heard(topics.DESC, Description))[:1]
    shown = eventually(lambda: [payload for topic, payload in list(bench.said) if topic.endswith("/cam/eyes")][:3])
    bench.stop()
    assert described.cameras == (EYES,)
    first = frames.decode(shown[0])
    assert (first.sequence, first.width, first.height, first.jpeg) == (1, 4, 3, JPEG)


def test_pictures_are_counted_and_one_that_is_not_there_is_none() -> None:
    given = iter([JPEG, None, JPEG])
    driver, told = Seeing(lambda: next(given, None)), list[CameraFrame]()
    filmer = Filmer([EYES], driver, name="cart", film=lambda _, frame: told.append(frame))
    filmer.start()
    eventually(lambda: driver.asked > 4)
    filmer.stop()
    filmer.stop()
    assert [frame.sequence for frame in told] == [1, 2]


def test_trouble_is_logged_once_with_what_to_do_and_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    well, told = threading.Event(), threading.Event()

    def dark() -> bytes:
        if well.is_set():
            return JPEG
        raise DriverError("the lens is covered")

    def large(_: str, frame: CameraFrame) -> None:
        told.set()
        raise ProtocolError(f"a picture of {len(frame.jpeg)} bytes")

    driver = Seeing(dark)
    filmer = Filmer([EYES], driver, name="cart", film=large)
    with caplog.at_level(logging.WARNING):
        filmer.start()
        eventually(lambda: driver.asked > 3)
        well.set()
        assert told.wait(15)
        seen = driver.asked
        eventually(lambda: driver.asked > seen + 2)
        filmer.stop()
    texts = [record.getMessage() for record in caplog.records]
    assert texts == [
        "cart: camera eyes: the lens is covered",
        f"cart: camera eyes: a picture of {len(JPEG)} bytes; have it take smaller pictures",
    ]


def test_without_eyes_nothing_is_filmed() -> None:
    told = list[CameraFrame]()
    filmer = Filmer([EYES], None, name="cart", film=lambda _, frame: told.append(frame))
    filmer.start()
    filmer.stop()
    assert told == []
