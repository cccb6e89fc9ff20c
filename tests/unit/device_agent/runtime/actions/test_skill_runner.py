"""Skills: speech, behaviours and stiffness by manifest and by driver."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from device_agent.ports.skills import Skill, SkillContext, SkillError
from device_agent.ports.speech import SpeechError, Spoken
from device_agent.ports.uploads import UploadError
from device_agent.protocol import Event, GrantLease, MoveJoints, RunBehaviour, Say, SetStiffness, State, Task, topics
from device_agent.protocol.manifests.capabilities import Keyframe
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.actions import speech_output
from device_agent.runtime.actions.skill_runner import SkillRunner
from device_agent.runtime.actions.speech_output import SpeechOutput
from device_agent.runtime.control.joint_stiffness import JointStiffness
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.actions.robot_api_fixture import device_context
from tests.unit.device_agent.runtime.conftest import MakeDevice


class Servos(FakeDriver):
    """A driver with stiffness; a compliant joint stays where the test moves it."""

    performs: tuple[str, ...] = ("stiffness",)

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

    def perform(self, skill: Skill, context: SkillContext) -> None:
        assert isinstance(skill, SetStiffness)
        assert not context.ended
        if self.fails:
            raise SkillError("the servos do not answer")
        self.stiffness = skill.value


class FakeSpeech:
    """Speech synthesis with a fixed duration of 0.2 s."""

    def __init__(self, *, broken: bool = False) -> None:
        self.broken = broken
        self.spoken: list[tuple[str, str]] = []

    def speak(self, text: str, language: str) -> Spoken | None:
        if self.broken:
            raise SpeechError("no speech today")
        self.spoken.append((text, language))
        return Spoken(b"RIFF", 0.2)


class Store:
    """Stores uploads, or fails, or hangs until ``ended``."""

    def __init__(self, mode: str = "") -> None:
        self.mode = mode
        self.stored: list[dict[str, Any]] = []
        self.ended = threading.Event()

    def store(self, device: str, **file: Any) -> str:
        if self.mode == "fails":
            raise UploadError("no network")
        if self.mode == "hangs":
            self.ended.wait(30)
        self.stored.append({"device": device, **file})
        return "u1"


def actor(**changes: Any) -> RobotType:
    parts: dict[str, Any] = {
        "capabilities": ("speech", "stiffness", "behaviours"),
        "visemes": {"aa": {"elbow": 0.2}, "PP": {"elbow": 0.0}},
        "behaviours": {
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
    }
    return robot_type(**(parts | changes))


MakeActor = Callable[..., tuple[DeviceHarness, Servos]]


@pytest.fixture
def make_actor(make_device: MakeDevice) -> MakeActor:
    def make(driver: Servos | None = None, **parts: Any) -> tuple[DeviceHarness, Servos]:
        driver = driver or Servos()
        return make_device(**({"driver": driver, "kind": actor()} | parts)), driver

    return make


def spoken(harness: DeviceHarness) -> list[Event]:
    """The events of the lines that have started."""
    events: list[Event] = eventually(lambda: harness.events("speech-started"))
    return events


# ---------------------------------------------------------------- speech


@pytest.mark.slow
def test_speech_is_published_as_text_and_moves_the_mouth(make_actor: MakeActor) -> None:
    harness, driver = make_actor()
    harness.done(Say(text="Aha, mama!", language="sk"), epoch=1)
    (event,) = spoken(harness)
    assert (event.message, event.data["language"]) == ("Aha, mama!", "sk")
    assert event.data["duration_s"] == pytest.approx(10 / 14, abs=0.01)
    assert "upload" not in event.data
    assert max(driver.elbows) > 0.02
    assert driver.elbows[-1] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize(("mode", "upload"), [("", "u1"), ("fails", None), ("hangs", None)])
def test_synthesized_audio_is_uploaded_and_named_if_in_time(
    make_actor: MakeActor, mode: str, upload: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if mode == "hangs":
        monkeypatch.setattr(speech_output, "_UPLOAD_TIMEOUT_S", 0.05)
    speech, store = FakeSpeech(), Store(mode)
    harness, _ = make_actor(speech=speech, uploads=store)
    harness.done(Say(text="hello"), epoch=1)
    (event,) = spoken(harness)
    assert event.data.get("upload") == upload
    assert event.data["duration_s"] == 0.2
    assert speech.spoken == [("hello", "")]
    if upload:
        stored = {"device": "arm", "stream": "speech", "media_type": "audio/wav", "content": b"RIFF"}
        assert stored.items() <= store.stored[0].items()
    store.ended.set()


@pytest.mark.parametrize(
    "parts", [{"speech": FakeSpeech(broken=True), "kind": actor(visemes={})}, {"speech": FakeSpeech()}]
)
def test_without_synthesis_or_storage_the_text_is_published(make_actor: MakeActor, parts: dict[str, Any]) -> None:
    harness, _ = make_actor(**parts)
    harness.done(Say(text="hi"), epoch=1)
    assert [event.message for event in spoken(harness)] == ["hi"]


@pytest.mark.parametrize(
    ("request_", "kind", "line"),
    [(Say(text="a" * 1000), actor(visemes={}), "a" * 1000), (RunBehaviour(name="speech"), actor(), "so much to say")],
)
def test_stop_ends_speech_before_the_next_line(
    make_actor: MakeActor, request_: Task, kind: RobotType, line: str
) -> None:
    harness, _ = make_actor(kind=kind)
    running = harness.command(request_, epoch=1)
    spoken(harness)
    harness.receive_stop()
    assert harness.end_code(running) == "stopped"
    assert [event.message for event in spoken(harness)] == [line]


@pytest.mark.parametrize(
    ("text", "language", "message"), [("  ", "", "the text is empty"), ("a", "-v x", "is not a language")]
)
def test_invalid_speech_is_rejected(text: str, language: str, message: str) -> None:
    with pytest.raises(Refused, match=message):
        SpeechOutput().prepare(text, language)


def test_the_driver_receives_the_speech_duration() -> None:
    durations: list[float] = []
    output = SpeechOutput(on_start=durations.append)
    utterance = output.prepare("hello, how are you today", "")
    assert durations == []
    output.start(utterance)
    assert durations == [utterance.duration_s]
    SpeechOutput().start(utterance)


# ---------------------------------------------------------------- behaviours


class Speaking(Servos):
    """A driver that speaks itself."""

    performs = ("speech",)

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def perform(self, skill: Skill, context: SkillContext) -> None:
        del context
        assert isinstance(skill, Say)
        self.lines.append(skill.text)


@pytest.mark.slow
def test_a_behaviour_moves_and_speaks_in_its_time(make_actor: MakeActor) -> None:
    driver = Speaking()
    harness, _ = make_actor(driver)
    start_s = time.monotonic()
    harness.done(RunBehaviour(name="bow"), epoch=1)
    assert time.monotonic() - start_s >= 0.6
    assert [event.message for event in spoken(harness)] == ["Good day"]
    assert eventually(lambda: driver.lines) == ["Good day"]
    assert driver.position == pytest.approx([0.0, 0.0], abs=1e-3)
    message = harness.failed(RunBehaviour(name="dance"), epoch=1).message
    assert "no behaviour 'dance'; there are bow, speech" in message


# ---------------------------------------------------------------- stiffness


@pytest.mark.slow
def test_a_compliant_joint_is_tracked_and_does_not_jump_when_stiffened(make_actor: MakeActor) -> None:
    harness, driver = make_actor()

    def set_stiffness(value: float, *joints: str, shown: dict[str, float]) -> None:
        harness.done(SetStiffness(value=value, joints=joints), epoch=1)
        eventually(lambda: harness.published(topics.STATE, State)[-1].stiffness == shown)

    set_stiffness(0.0, shown={"shoulder": 0.0, "elbow": 0.0})
    assert driver.stiffness == 0.0
    driver.position = (0.0, 1.2)
    eventually(lambda: abs(harness.telemetry().commanded_rad[1] - 1.2) < 1e-6)
    assert "elbow: compliant" in harness.telemetry().limited
    move = MoveJoints(position_rad={"elbow": 1.0}, speed=1.0)
    assert "elbow: no stiffness; set a stiffness above 0" in harness.failed(move, epoch=1).message
    assert "no stiffness" in harness.failed(RunBehaviour(name="bow"), epoch=1).message
    set_stiffness(0.6, "elbow", shown={"shoulder": 0.0, "elbow": 0.6})
    assert driver.position[1] == pytest.approx(1.2)
    assert driver.jumped < 0.01
    set_stiffness(1.0, shown={})
    harness.done(move, epoch=1)


def test_after_an_action_setpoints_keep_unnamed_joints(make_actor: MakeActor) -> None:
    harness, driver = make_actor()
    harness.done(GrantLease(holder="ann", lease_ms=30_000), epoch=1)
    harness.setpoint(1, 1, elbow=0.2)
    harness.done(MoveJoints(position_rad={"shoulder": 0.3}, speed=1.0), epoch=1)
    for sequence in range(2, 20):
        harness.setpoint(1, sequence, elbow=0.1)
        time.sleep(0.02)
    assert driver.position[0] == pytest.approx(0.3, abs=1e-3)


def test_failed_and_invalid_stiffness_changes_leave_joints_stiff(make_actor: MakeActor) -> None:
    harness, driver = make_actor()
    driver.fails = True
    assert "the servos do not answer" in harness.failed(SetStiffness(value=0.0), epoch=1).message
    message = harness.failed(SetStiffness(value=0.5, joints=("nose",)), epoch=1).message
    assert "no joint 'nose'; there are shoulder, elbow" in message
    eventually(lambda: harness.telemetry().limited == ())
    harness.done(MoveJoints(position_rad={"elbow": 0.1}, speed=1.0), epoch=1)


def test_a_compliant_joint_outside_its_range_is_clamped() -> None:
    stiffness = JointStiffness(robot_type())
    stiffness.set({"elbow": 0.0})
    assert stiffness.track((0.5, 3.3)) == {1: 3.0}


def test_a_skill_waits_for_rest_unless_its_action_ended() -> None:
    context = replace(device_context(actor()), controller=SimpleNamespace(moving=True))  # type: ignore[arg-type]
    mover: Any = SimpleNamespace(ended=threading.Event(), reservation=SimpleNamespace(why=None))
    threading.Timer(0.1, mover.ended.set).start()
    with pytest.raises(Refused, match="the action ended"):
        SkillRunner(context, mover).wait_for_rest()
