"""Skills: speech, behaviours and stiffness by manifest and by driver."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent.ports.driver import Observation
from device_agent.ports.skills import Skill, SkillError, Stage
from device_agent.ports.speech import SpeechError, Spoken
from device_agent.ports.uploads import UploadError
from device_agent.protocol import (
    AckStatus,
    Event,
    GrantLease,
    MoveJoints,
    RunBehaviour,
    Say,
    SetStiffness,
    State,
    Stop,
    topics,
)
from device_agent.protocol.manifests.capabilities import Keyframe
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.skill_runner import SkillRunner
from device_agent.runtime.actions.speech_output import SpeechOutput
from device_agent.runtime.control.joint_stiffness import JointStiffness
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually

WAIT_S = 0.3


class Servos(FakeDriver):
    """A driver with stiffness; a compliant joint stays where the test moves it."""

    performs = ("stiffness",)

    def __init__(self) -> None:
        super().__init__()
        self.stiffness = 1.0
        self.fails = False
        self.jumped = 0.0
        self.elbows: list[float] = []

    def send(self, position_rad: Any) -> tuple[float, ...]:
        self.elbows.append(position_rad[1])
        if self.stiffness > 0:
            self.jumped = max(self.jumped, abs(position_rad[1] - self.position[1]))
            self.position = tuple(position_rad)
        return tuple(position_rad)

    def observe(self) -> Observation:
        return Observation(self.position, (0.0, 0.0), (0.0, 0.0), ())

    def perform(self, skill: Skill, stage: Stage) -> None:
        assert isinstance(skill, SetStiffness)
        assert not stage.ended
        if self.fails:
            raise SkillError("the servos do not answer")
        self.stiffness = skill.value


class FakeSpeech:
    """Speech synthesis with a fixed duration of 0.2 s."""

    def __init__(self, *, broken: bool = False) -> None:
        self.broken = broken
        self.said: list[tuple[str, str]] = []

    def speak(self, text: str, language: str) -> Spoken | None:
        if self.broken:
            raise SpeechError("no speech today")
        self.said.append((text, language))
        return Spoken(b"RIFF", 0.2)


class Store:
    """Keeps what is uploaded, or fails to, or never ends."""

    def __init__(self, how: str = "") -> None:
        self.how = how
        self.kept: list[dict[str, Any]] = []
        self.ended = threading.Event()

    def store(self, device: str, **file: Any) -> str:
        if self.how == "fails":
            raise UploadError("no network")
        if self.how == "hangs":
            self.ended.wait(30)
        self.kept.append({"device": device, **file})
        return "u1"


def actor() -> RobotType:
    kind = robot_type()
    return msgspec.structs.replace(
        kind,
        capabilities=("speech", "stiffness", "behaviours"),
        visemes={"aa": {"elbow": 0.2}, "PP": {"elbow": 0.0}},
        behaviours={
            "bow": (
                Keyframe(time_s=0.3, position_rad={"shoulder": 0.1}),
                Keyframe(time_s=0.6, position_rad={"shoulder": 0.0}, say="Good day"),
            ),
            "speech": (
                Keyframe(time_s=0.0, say="so much to say"),
                Keyframe(time_s=60.0),
                Keyframe(time_s=61.0, say="more"),
            ),
        },
    )


def make(folder: Path, **more: Any) -> DeviceHarness:
    harness = DeviceHarness(
        folder, driver=more.pop("driver", None) or Servos(), kind=more.pop("kind", None) or actor(), **more
    )
    harness.start()
    return harness


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[DeviceHarness]:
    harness = make(tmp_path)
    yield harness
    harness.stop()


def servos(harness: DeviceHarness) -> Servos:
    assert isinstance(harness.driver, Servos)
    return harness.driver


def said(harness: DeviceHarness) -> list[Event]:
    return [event for event in harness.heard(topics.EVENT, Event) if event.kind == "speech-started"]


def ends(harness: DeviceHarness, request: Any, epoch: int = 1) -> AckStatus:
    ack = harness.end(harness.command(request, epoch=epoch))
    assert ack.status is AckStatus.DONE, ack.reason
    return ack.status


def why(harness: DeviceHarness, request: Any, epoch: int = 1) -> str:
    reason = harness.end(harness.command(request, epoch=epoch)).reason
    assert reason is not None
    return reason.message


# ---------------------------------------------------------------- speech


def test_speech_is_published_as_text_and_moves_the_mouth(harness: DeviceHarness) -> None:
    ends(harness, Say(text="Aha, mama!", language="sk"))
    (event,) = eventually(lambda: said(harness))
    assert (event.message, event.data["language"]) == ("Aha, mama!", "sk")
    assert event.data["duration_s"] == pytest.approx(10 / 14, abs=0.01)
    assert "upload" not in event.data
    assert max(servos(harness).elbows) > 0.02
    assert servos(harness).elbows[-1] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize(("how", "upload"), [("", "u1"), ("fails", None), ("hangs", None)])
def test_synthesized_audio_is_uploaded_and_named_if_in_time(tmp_path: Path, how: str, upload: str | None) -> None:
    speech, store = FakeSpeech(), Store(how)
    harness = make(tmp_path, speech=speech, uploads=store)
    ends(harness, Say(text="hello"))
    (event,) = eventually(lambda: said(harness))
    assert event.data.get("upload") == upload
    assert event.data["duration_s"] == 0.2
    assert speech.said == [("hello", "")]
    if upload:
        wanted = {"device": "arm", "stream": "speech", "media_type": "audio/wav", "content": b"RIFF"}
        assert wanted.items() <= store.kept[0].items()
    store.ended.set()
    harness.stop()


def test_failed_synthesis_leaves_the_text(tmp_path: Path) -> None:
    harness = make(tmp_path, speech=FakeSpeech(broken=True), kind=msgspec.structs.replace(actor(), visemes={}))
    ends(harness, Say(text="hi"))
    assert [event.message for event in eventually(lambda: said(harness))] == ["hi"]
    harness.stop()


def test_synthesis_without_storage_still_speaks(tmp_path: Path) -> None:
    harness = make(tmp_path, speech=FakeSpeech())
    ends(harness, Say(text="hi"))
    assert [event.message for event in eventually(lambda: said(harness))] == ["hi"]
    harness.stop()


def test_stop_ends_speech_without_a_mouth(tmp_path: Path) -> None:
    harness = make(tmp_path, kind=msgspec.structs.replace(actor(), visemes={}))
    running = harness.command(Say(text="a" * 1000), epoch=1)
    eventually(lambda: said(harness))
    harness.receive(topics.STOP, msgspec.json.encode(Stop(id="s1", caller="bob", reason="enough")))
    assert harness.end_code(running) == "stopped"
    harness.stop()


@pytest.mark.parametrize(
    ("text", "language", "says"), [("  ", "", "nothing to say"), ("a", "-v x", "is not a language")]
)
def test_invalid_speech_is_rejected(text: str, language: str, says: str) -> None:
    with pytest.raises(Refused, match=says):
        SpeechOutput().prepare(text, language)


def test_speech_without_observers_starts() -> None:
    speaker = SpeechOutput()
    speaker.start(speaker.prepare("hello", ""))


def test_the_driver_receives_the_speech_duration() -> None:
    heard: list[float] = []
    speaker = SpeechOutput(on_start=heard.append)
    said = speaker.prepare("hello, how are you today", "")
    assert heard == []
    speaker.start(said)
    assert heard == [said.duration_s]


# ---------------------------------------------------------------- behaviours


def test_a_behaviour_moves_and_speaks_in_its_time(harness: DeviceHarness) -> None:
    start_s = time.monotonic()
    ends(harness, RunBehaviour(name="bow"))
    assert time.monotonic() - start_s >= 0.6
    assert [event.message for event in eventually(lambda: said(harness))] == ["Good day"]
    assert harness.driver.position == pytest.approx([0.0, 0.0], abs=1e-3)


def test_an_unknown_behaviour_is_rejected_with_the_known_ones(harness: DeviceHarness) -> None:
    assert "no behaviour 'dance'; there are bow, speech" in why(harness, RunBehaviour(name="dance"))


def test_stop_ends_a_behaviour_before_its_next_line(harness: DeviceHarness) -> None:
    running = harness.command(RunBehaviour(name="speech"), epoch=1)
    eventually(lambda: said(harness))
    harness.receive(topics.STOP, msgspec.json.encode(Stop(id="s1", caller="bob", reason="enough")))
    assert harness.end_code(running) == "stopped"
    assert [event.message for event in said(harness)] == ["so much to say"]


class Speaking(Servos):
    """A driver that speaks itself."""

    performs = ("speech",)

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[str] = []

    def perform(self, skill: Skill, stage: Stage) -> None:
        del stage
        assert isinstance(skill, Say)
        self.heard.append(skill.text)


def test_a_driver_with_speech_speaks_the_lines_of_a_behaviour(tmp_path: Path) -> None:
    driver = Speaking()
    harness = make(tmp_path, driver=driver)
    ends(harness, RunBehaviour(name="bow"))
    assert eventually(lambda: driver.heard) == ["Good day"]
    harness.stop()


# ---------------------------------------------------------------- stiffness


def test_a_compliant_joint_is_tracked_and_does_not_jump_when_stiffened(harness: DeviceHarness) -> None:
    ends(harness, SetStiffness(value=0.0))
    assert servos(harness).stiffness == 0.0
    state: State = eventually(lambda: [one for one in harness.heard(topics.STATE, State) if one.stiffness])[-1]
    assert state.stiffness == {"shoulder": 0.0, "elbow": 0.0}
    harness.driver.position = (0.0, 1.2)
    eventually(lambda: abs(harness.telemetry().commanded_rad[1] - 1.2) < 1e-6)
    assert "elbow: compliant" in harness.telemetry().limited
    assert "elbow: no stiffness; set a stiffness above 0" in why(harness, MoveJoints(position_rad={"elbow": 0.0}))
    assert "no stiffness" in why(harness, RunBehaviour(name="bow"))
    ends(harness, SetStiffness(value=0.6, joints=("elbow",)))
    time.sleep(WAIT_S)
    assert harness.driver.position[1] == pytest.approx(1.2)
    assert servos(harness).jumped < 0.01
    shown = {"shoulder": 0.0, "elbow": 0.6}
    assert eventually(lambda: harness.heard(topics.STATE, State)[-1].stiffness == shown)
    ends(harness, SetStiffness(value=1.0))
    assert eventually(lambda: harness.heard(topics.STATE, State)[-1].stiffness == {})
    ends(harness, MoveJoints(position_rad={"elbow": 1.0}, speed=1.0))


def test_after_an_action_setpoints_keep_unnamed_joints(harness: DeviceHarness) -> None:
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=30_000), epoch=1))
    harness.setpoint(1, 1, elbow=0.2)
    ends(harness, MoveJoints(position_rad={"shoulder": 0.3}, speed=1.0))
    for sequence in range(2, 20):
        harness.setpoint(1, sequence, elbow=0.1)
        time.sleep(0.02)
    assert harness.driver.position[0] == pytest.approx(0.3, abs=1e-3)


def test_failed_stiffness_changes_leave_joints_stiff(harness: DeviceHarness) -> None:
    servos(harness).fails = True
    assert "the servos do not answer" in why(harness, SetStiffness(value=0.0))
    assert eventually(lambda: harness.telemetry().limited == ())
    ends(harness, MoveJoints(position_rad={"elbow": 0.1}, speed=1.0))


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        (SetStiffness(value=0.5, joints=("nose",)), "no joint 'nose'; there are shoulder, elbow"),
        ("robot.stiffness(2)", "not a valid message: Expected `float` <= 1.0 - at `$.value`"),
    ],
)
def test_an_invalid_stiffness_is_rejected(harness: DeviceHarness, request_: Any, says: str) -> None:
    assert says in why(harness, harness.script(request_) if isinstance(request_, str) else request_)


def test_a_compliant_joint_outside_its_range_is_clamped() -> None:
    slack = JointStiffness(robot_type())
    slack.set({"elbow": 0.0})
    assert slack.track((0.5, 3.3)) == {1: 3.0}


# ---------------------------------------------------------------- before it begins


class Late:
    """An action that is over at once."""

    def __init__(self) -> None:
        self.ended = threading.Event()
        self.reservation: Any = type("Reservation", (), {"why": None})()


class Restless:
    """A controller of something that moves for ever."""

    moving = True


def test_a_skill_waits_for_rest_unless_its_action_ended() -> None:
    mover: Any = Late()
    controller: Any = Restless()
    body = DeviceContext(
        robot_type=actor(),
        controller=controller,
        observe=lambda: None,
        geometry=None,
        skills=None,
        readings=None,  # type: ignore[arg-type]
    )
    threading.Timer(0.1, mover.ended.set).start()
    with pytest.raises(Refused, match="the action ended"):
        SkillRunner(body, mover).wait_for_rest()
