"""Signed consent to record cameras, and what the recording of a session then contains."""

import base64
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.ports.clock import wall_ms
from device_agent.ports.sensor import Frame
from device_agent.protocol import CameraStream, GrantLease, SetCameraConsent, State, codec, topics
from device_agent.protocol.commands import Command
from device_agent.protocol.security import signing
from device_agent.runtime.recording.camera_consent import CameraConsents
from device_agent.runtime.recording.camera_recorder import CameraRecorder
from device_agent.runtime.recording.folder import RecordingFolder
from device_agent.runtime.recording.recorder import Recorder
from device_agent.runtime.storage.journal import Journal
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import OWNER, DeviceHarness, eventually, wait_for_state
from tests.harness.agent.recordings.segments import limits, sealed_messages
from tests.unit.device_agent.runtime.room.room_device_fixture import RoomDeviceHarness, await_growth

EYES = CameraStream(name="eyes", rate_hz=100.0)


class CameraDriver(FakeDriver):
    """A driver whose pictures contain the time of their exposure [ns]."""

    def __init__(self) -> None:
        super().__init__()
        self.taken: list[int] = []

    def frame(self, _camera: str) -> Frame:
        taken_s = time.monotonic()
        self.taken.append(round(taken_s * 1e9))
        return Frame(4, 3, str(self.taken[-1]).encode(), taken_s)


class RecordedRobot(DeviceHarness):
    """A robot with a camera, its recorder, and the consents of its agent."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.consents = Journal(folder / "consents.db")
        self.consents.open(now_ms=wall_ms())
        cameras = CameraRecorder("a", CameraConsents(self.consents, space="s", account=OWNER), rate_hz=30.0)
        self.recorder = Recorder(limits(folder / "recordings"), owner="s/ann", cameras=cameras)
        self.recorder.start()
        super().__init__(folder, driver=CameraDriver(), kind=robot_type(cameras=(EYES,)), recorder=self.recorder)

    def stop(self) -> None:
        self.recorder.stop_cameras()
        super().stop()
        self.recorder.stop()
        self.consents.close()

    @property
    def taken(self) -> list[int]:
        assert isinstance(self.driver, CameraDriver)
        return self.driver.taken

    def take_pictures(self) -> None:
        """Wait for twenty pictures more, of which a part is recorded with consent."""
        count = len(self.taken)
        eventually(lambda: len(self.taken) > count + 20)

    def state(self) -> State:
        newest: State = self.published(topics.STATE, State)[-1]
        return newest

    def lease(self, epoch: int = 3) -> None:
        self.done(GrantLease(holder="ann", lease_ms=600_000), epoch=epoch)
        wait_for_state(self, lambda state: state.recording)

    def consent(self, *cameras: str, number: int, **changes: Any) -> str:
        request = SetCameraConsent(cameras=cameras, account=changes.pop("account", OWNER), number=number)
        return self.command(request, **changes)

    def recorded(self, *cameras: str) -> None:
        wait_for_state(self, lambda state: state.recorded_cameras == cameras)

    def frames(self) -> list[tuple[int, dict[str, Any]]]:
        """Time of the exposure [ns] and message of each recorded frame; ends the recording."""
        self.stop()
        paths = [each.path for each in RecordingFolder(self.folder / "recordings").segments()]
        messages = itertools.chain.from_iterable(sealed_messages(path, "/frames/eyes") for path in paths)
        return [(int(base64.b64decode(message["data"])), message) for message in messages]


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[RecordedRobot]:
    made = RecordedRobot(tmp_path)
    made.start()
    yield made
    made.stop()


def test_without_consent_a_session_has_no_frames(robot: RecordedRobot) -> None:
    robot.lease()
    robot.take_pictures()
    assert robot.state().recorded_cameras == ()
    consent = robot.state().camera_consent
    assert consent is not None
    assert (consent.cameras, consent.number) == ((), 0)
    assert robot.frames() == []


def test_frames_are_recorded_only_between_consent_and_withdrawal(robot: RecordedRobot) -> None:
    robot.lease()
    before_ns = time.monotonic_ns()
    robot.end(robot.consent("eyes", number=1))
    robot.recorded("eyes")
    eventually(lambda: robot.events("cameras-recorded"))
    robot.take_pictures()
    withdrawal = robot.consent(number=2)
    robot.end(withdrawal)
    after_ns = time.monotonic_ns()
    robot.recorded()
    eventually(lambda: robot.events("cameras-not-recorded"))
    robot.take_pictures()
    frames = robot.frames()
    assert len(frames) >= 3
    assert all(before_ns < taken_ns < after_ns for taken_ns, _ in frames)
    assert {taken_ns for taken_ns, _ in frames} <= set(robot.taken)


def test_only_the_owner_decides_and_a_copy_of_an_old_consent_changes_nothing(robot: RecordedRobot) -> None:
    old = Command(
        id="old",
        space="s",
        agent="a",
        device="arm",
        issued_at_ms=wall_ms(),
        ttl_ms=60_000,
        caller="ann",
        epoch=0,
        request=SetCameraConsent(cameras=("eyes",), account=OWNER, number=1),
    )
    payload = signing.sign(codec.encode(old), robot.key)
    robot.receive(topics.CMD, payload)
    robot.end("old")
    robot.end(robot.consent(number=2))
    robot.receive(topics.CMD, payload)
    assert robot.end_code(robot.consent("eyes", number=1)) == "outdated"
    assert robot.end_code(robot.consent("eyes", number=3, account="account-of-bob")) == "not_owner"
    assert robot.end_code(robot.consent("nose", number=3)) == "unknown_camera"
    state = wait_for_state(robot, lambda state: state.camera_consent and state.camera_consent.number == 2)
    assert state.camera_consent is not None
    assert (state.camera_consent.cameras, state.camera_consent.by) == ((), "ann")


def test_a_device_that_is_not_recorded_rejects_consent(tmp_path: Path) -> None:
    robot = DeviceHarness(tmp_path)
    robot.start()
    try:
        request = SetCameraConsent(cameras=(), account=OWNER, number=1)
        assert robot.end_code(robot.command(request)) == "cannot"
    finally:
        robot.stop()


def test_a_camera_of_the_room_is_recorded_in_the_session_of_a_robot(robot: RecordedRobot, tmp_path: Path) -> None:
    folder = tmp_path / "room"
    folder.mkdir()
    room = RoomDeviceHarness(folder, recorder=robot.recorder)
    room.start()
    try:
        robot.lease()
        request = SetCameraConsent(cameras=("garden",), account=OWNER, number=1)
        room.end(room.command(request, epoch=0))
        wait_for_state(room, lambda state: state.recorded_cameras == ("garden",))
        robot.recorded("a-arm/garden")
        await_growth(room.pictures, 10)
    finally:
        room.stop()
    assert robot.frames() == []
    paths = [each.path for each in RecordingFolder(tmp_path / "recordings").segments()]
    assert any(sealed_messages(path, "/frames/a-arm/garden") for path in paths)
