"""Which frames of which cameras are recorded, and how that is shown."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from device_agent.config.agent_config import AgentConfig, DeviceEntry, Indicator, Recording
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import Pairing
from device_agent.ports.sensor import Frame
from device_agent.protocol import CameraStream, Control, SetCameraConsent, camera_frames
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.errors import Refused
from device_agent.runtime.recording import camera_recorder as module
from device_agent.runtime.recording.camera_consent import CameraConsents
from device_agent.runtime.recording.camera_recorder import CameraRecorder, DeviceCameras
from device_agent.runtime.recording.messages import RecordedFrame
from device_agent.runtime.storage.journal import Journal
from tests.harness.agent.recordings.device import Recorded

OWNER = "account-of-ann"
JPEG = b"\xff\xd8 a picture"
FRONT = CameraStream(name="front", rate_hz=10.0)
DEPTH = CameraStream(name="depth", rate_hz=10.0, kind=camera_frames.DEPTH)


@dataclass
class FakeIndicator:
    """An indicator that a test switches."""

    required = False
    shown = True
    error = ""
    started = stopped = False

    def covers(self, at_s: float) -> bool:
        return self.shown and at_s > 0

    def require(self, required: bool) -> None:
        self.required = required

    def start(self) -> None:
        self.started = True

    def stop(self) -> None:
        self.stopped = True


class Cameras:
    """The cameras of a robot ``arm`` and of a room device ``door``, and the sessions of the robot."""

    def __init__(self, folder: Path, *, indicator: FakeIndicator | None = None) -> None:
        self.journal = Journal(folder / "journal.db")
        self.journal.open(now_ms=0)
        self.recorded = Recorded()
        self.events = list[EventRecord]()
        consents = CameraConsents(self.journal, space="lab", account=OWNER)
        self.recorder = CameraRecorder("agent", consents, rate_hz=5.0, indicator=indicator)  # type: ignore[arg-type]
        self.recorder.add_session(self.recorded.device)
        arm = self.recorder.add("arm", (FRONT, DEPTH), self.recorded.device, self.events.append)
        door = self.recorder.add("door", (FRONT,), None, self.events.append)
        assert arm is not None
        assert door is not None
        self.arm, self.door = arm, door
        self.number = 0

    def consent(self, device: DeviceCameras, *cameras: str) -> None:
        self.number += 1
        device.decide(SetCameraConsent(cameras=cameras, account=OWNER, number=self.number), caller="ann")

    def begin(self) -> None:
        """Begin a session of the robot, whose recording is confirmed."""
        self.recorded.now_s = time.monotonic()
        self.recorded.run()
        self.recorded.take()

    def take(self, device: DeviceCameras, *, camera: str = "front", at_s: float | None = None) -> list[RecordedFrame]:
        """Take a picture; returns the frames that are recorded."""
        device.record(camera, Frame(4, 3, JPEG, time.monotonic() if at_s is None else at_s))
        return self.frames()

    def frames(self) -> list[RecordedFrame]:
        return [frame for batch in self.recorded.take() for frame in batch.frames]


@pytest.fixture
def indicator() -> FakeIndicator:
    return FakeIndicator()


@pytest.fixture
def cameras(tmp_path: Path) -> Iterator[Cameras]:
    made = Cameras(tmp_path)
    yield made
    made.journal.close()


@pytest.fixture
def indicated(tmp_path: Path, indicator: FakeIndicator) -> Iterator[Cameras]:
    made = Cameras(tmp_path, indicator=indicator)
    yield made
    made.journal.close()


def test_a_frame_with_consent_has_its_topic_and_the_time_of_its_exposure(cameras: Cameras) -> None:
    cameras.consent(cameras.arm, "front")
    cameras.begin()
    taken_s = time.monotonic()
    time.sleep(0.01)
    (frame,) = cameras.take(cameras.arm, at_s=taken_s)
    assert (frame.topic, frame.tick_ns, frame.data) == ("/frames/front", round(taken_s * 1e9), JPEG)
    assert frame.at_ms == pytest.approx((time.time() - (time.monotonic() - taken_s)) * 1000, abs=5)


def test_without_consent_nothing_is_recorded(cameras: Cameras) -> None:
    cameras.begin()
    assert not cameras.arm.is_due("front", time.monotonic())
    assert cameras.take(cameras.arm) == []
    cameras.consent(cameras.door, "front")
    assert cameras.take(cameras.arm) == [], "consent is that of one device"
    assert cameras.arm.recorded == ("agent-door/front",)


def test_without_a_session_nothing_is_recorded(cameras: Cameras) -> None:
    cameras.consent(cameras.arm, "front")
    assert not cameras.arm.is_due("front", time.monotonic())
    assert cameras.take(cameras.arm) == []
    assert cameras.arm.recorded == ()


def test_a_withdrawal_discards_frames_that_still_wait(cameras: Cameras) -> None:
    cameras.consent(cameras.arm, "front")
    cameras.begin()
    cameras.arm.record("front", Frame(4, 3, JPEG, time.monotonic()))
    cameras.consent(cameras.arm)
    assert cameras.frames() == []
    assert cameras.take(cameras.arm) == []


def test_cameras_of_the_room_are_recorded_in_the_sessions_of_the_agents_robots(cameras: Cameras) -> None:
    cameras.consent(cameras.door, "front")
    cameras.begin()
    (frame,) = cameras.take(cameras.door)
    assert frame.topic == "/frames/agent-door/front"
    assert (cameras.door.recorded, cameras.arm.recorded) == (("front",), ("agent-door/front",))


def test_frames_are_limited_to_the_rate_of_the_configuration(cameras: Cameras) -> None:
    cameras.consent(cameras.arm, "front")
    cameras.begin()
    start_s = time.monotonic()
    count = 0
    for number in range(120):  # 12 Hz for ten seconds
        at_s = start_s + number / 12
        due = cameras.arm.is_due("front", at_s)
        recorded = cameras.take(cameras.arm, at_s=at_s)
        assert due == bool(recorded)
        count += len(recorded)
    assert 48 <= count <= 51
    assert cameras.take(cameras.arm, at_s=start_s) == [], "an older picture"


def test_other_pictures_than_colours_are_not_recorded(cameras: Cameras) -> None:
    cameras.begin()
    with pytest.raises(Refused, match="no camera 'depth'"):
        cameras.consent(cameras.arm, "depth")
    cameras.consent(cameras.arm, "front")
    cameras.arm.record("front", Frame(4, 3, b"PNG", time.monotonic(), camera_frames.DEPTH))
    assert cameras.frames() == []


def test_decisions_and_recorded_cameras_are_events(cameras: Cameras) -> None:
    cameras.consent(cameras.arm, "front")
    cameras.recorder.update()
    cameras.begin()
    for _ in range(2):
        cameras.recorder.update()
    cameras.consent(cameras.arm)
    cameras.arm.decide(SetCameraConsent(cameras=(), account=OWNER, number=cameras.number), caller="ann")
    cameras.recorder.update()
    assert [event.kind for event in cameras.events] == [
        EventKind.CAMERA_CONSENT_CHANGED,
        EventKind.CAMERAS_RECORDED,
        EventKind.CAMERA_CONSENT_CHANGED,
        EventKind.CAMERAS_NOT_RECORDED,
    ]
    assert cameras.events[0].message == "ann allows recording of front"
    assert cameras.events[1].data == cameras.events[3].data == {"cameras": ["front"]}
    assert cameras.events[2].message == "ann allows no camera to be recorded"


def test_cameras_are_not_shown_as_recorded_while_the_session_is_not(cameras: Cameras) -> None:
    cameras.consent(cameras.arm, "front")
    cameras.recorded.run()
    shown = [cameras.arm.recorded]
    cameras.recorded.take()
    shown.append(cameras.arm.recorded)
    cameras.recorded.device.end()
    shown.append(cameras.arm.recorded)
    assert shown == [(), ("front",), ()]


def test_devices_without_pictures_have_nothing_to_consent_to(cameras: Cameras) -> None:
    assert cameras.recorder.add("lamp", (DEPTH,), None, cameras.events.append) is None
    blind = cameras.recorder.add("cart", (), cameras.recorded.device, cameras.events.append)
    assert blind is not None
    assert blind.consent is None
    assert cameras.arm.consent is not None


def test_without_its_indicator_nothing_is_recorded(indicated: Cameras, indicator: FakeIndicator) -> None:
    indicator.shown = False
    indicated.recorder.start()
    indicated.consent(indicated.arm, "front")
    indicated.recorder.update()
    assert (indicator.started, indicator.required) == (True, False)
    indicated.begin()
    indicated.recorder.update()
    assert indicator.required
    assert indicated.take(indicated.arm) == []
    assert (indicated.arm.recorded, indicated.arm.faults()) == ((), ())
    indicator.error = "the lamp does not respond"
    (fault,) = indicated.arm.faults()
    assert fault.code == "camera-indicator"
    assert "the lamp does not respond" in fault.message
    assert indicated.door.faults() == ()
    indicator.shown, indicator.error = True, ""
    assert len(indicated.take(indicated.arm)) == 1
    assert indicated.arm.recorded == ("front",)
    indicated.recorder.stop()
    assert indicator.stopped


def test_an_agent_without_an_indicator_has_no_such_fault(cameras: Cameras) -> None:
    cameras.recorder.start()
    cameras.consent(cameras.arm, "front")
    cameras.begin()
    assert cameras.arm.faults() == ()
    cameras.recorder.stop()


LAMP = DeviceEntry(
    name="lamp",
    type="lamp",
    driver="tasmota",
    controls=(Control(name="light", label="Light", lower=0.0, upper=1.0),),  # type: ignore[arg-type]
)
PAIRING = Pairing(agent="agent", space="lab", account="Ann", keys={}, owner=OWNER)


@pytest.mark.parametrize(
    ("indicator", "message"),
    [
        (Indicator(device="lamp", control="power"), "'lamp' is no room device .* 'power'; its controls: light"),
        (Indicator(device="arm", control="light"), "'arm' is no room device .* its controls: none"),
        (Indicator(device="none", control="light"), "its controls: none"),
        (Indicator(device="lamp", control="light", on=2.0), "`on` and `off` of 'light' can be 0 to 1"),
        (Indicator(device="lamp", control="light", on=0.0), "`on` and `off` must differ"),
    ],
)
def test_an_indicator_that_cannot_work_is_an_error_at_the_start(
    tmp_path: Path, indicator: Indicator, message: str
) -> None:
    configuration = _configuration(indicator)
    with pytest.raises(ConfigError, match=message):
        module.create(configuration, Journal(tmp_path / "journal.db"), PAIRING, {})


def test_the_configuration_names_rate_and_indicator(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.db")
    recorder = module.create(_configuration(Indicator(device="lamp", control="light")), journal, PAIRING, {})
    assert (recorder.agent, recorder.period_s, recorder.indicator is None) == ("agent", 0.1, False)
    assert module.create(_configuration(None), journal, PAIRING, {}).indicator is None


def _configuration(indicator: Indicator | None) -> AgentConfig:
    devices = (DeviceEntry(name="arm", type="ur5"), LAMP)
    return AgentConfig(server="", name="lab", devices=devices, recording=Recording(indicator=indicator))
