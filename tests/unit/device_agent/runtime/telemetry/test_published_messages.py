"""Description, state, telemetry, frames and events of a device: content, topic, quality of service, and when."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from device_agent.ports.sandbox import SandboxStatus
from device_agent.protocol import (
    ActionState,
    Description,
    Event,
    Fault,
    InterlockDescription,
    LeaseState,
    Measurements,
    Mode,
    OpenRequest,
    Restriction,
    State,
    StopLatch,
    Twin,
    codec,
)
from device_agent.protocol.camera_frames import CameraFrame, decode
from device_agent.protocol.description import CameraStream
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.events import EventKind
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.room import Control, RoomDeviceManifest
from device_agent.runtime.authority.control_request import ControlRequest
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.authority.lease_gate import Lease
from device_agent.runtime.telemetry import device_publisher as module
from device_agent.runtime.telemetry.device_publisher import DevicePublisher, StateSnapshot
from device_agent.runtime.telemetry.rate_meter import WINDOW_S
from tests.harness.paths import ROBOTS

CONTROLS = (Control(name="pan", label="Pan", lower=-1.0, upper=1.0),)
CAMERAS = (CameraStream(name="front", rate_hz=10.0),)
EXPRESSIONS = cast("Any", {"smile": None})  # only the names are published
NAO = msgspec.structs.replace(robot_type.load(ROBOTS / "nao"), cameras=CAMERAS, expressions=EXPRESSIONS)
BASE = "ts/v1/s/a/arm/"
INTERLOCK = InterlockDescription(name="door", action="hold", speed=0.0, stale_ms=1000)
SNAPSHOT = StateSnapshot(
    mode=Mode.ACTION,
    epoch=7,
    ended=6,
    lease=Lease("ann", 7, 1012.0, "repair"),
    control_request=ControlRequest("r1", "bob", 7, 1003.5),
    latch=StopLatch(caller="cat", reason="smoke", at_ms=5),
    faults=(Fault(code="driver", message="no answer", since_ms=3),),
    action=ActionState(id="c1", kind="move_joints", progress=0.5),
    restrictions=(Restriction(source="door", speed=0.5, reason="a door is open"),),
    stiffness={"elbow": 0.5},
    load=0,
)
TWIN = Twin(device="arm", bodies=())
MEASURED = Measurements(sequence=1, at_ms=9, tick_ms=1, values={"temperature_c": 20.0})
FRAME = CameraFrame(sequence=1, tick_ms=2, width=3, height=4, content=b"jpeg")
Sent = tuple[str, bytes, dict[str, Any]]


class Fixture:
    """A publisher on a manual clock, and its messages."""

    def __init__(self, kind: RobotType, room: RoomDeviceManifest | None = None) -> None:
        self.sent: list[Sent] = []
        self.stored: list[Sent] = []
        self.recorded: list[Event] = []
        self.accepts = True
        outbox = SimpleNamespace(
            add_measurement=lambda *message, **options: self.stored.append((*message, options)),
            add_event=lambda *message, **options: self.stored.append((*message, options)),
        )
        self.publisher = DevicePublisher(
            address=("s", "a", "arm"),
            label="Arm",
            robot_type=kind,
            room_device=room,
            simulated=True,
            limits=["speed"],
            actions=["move_joints"],
            interlocks=[INTERLOCK],
            streaming=False,
            journal=cast("Any", None),
            publish=self.publish,
            outbox=cast("Any", outbox),
            record_event=self.recorded.append,
        )

    def publish(self, topic: str, payload: bytes, **options: Any) -> bool:
        if self.accepts:
            self.sent.append((topic, payload, options))
        return self.accepts

    def states(self) -> list[State]:
        return [codec.decode(payload, State) for topic, payload, _ in self.sent if topic == BASE + "state"]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now_s=1000.0)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    monkeypatch.setattr(module, "wall_ms", lambda: 2000)
    monkeypatch.setattr(module, "tick_ms", lambda: 30)
    monkeypatch.setattr(module, "STATE_MIN_GAP_S", 1.0)
    return clock


@pytest.fixture
def fixture(clock: SimpleNamespace) -> Fixture:  # noqa: ARG001 (the publisher uses it)
    return Fixture(NAO)


def described(fixture: Fixture) -> Description:
    fixture.publisher.publish_description(None)
    ((topic, payload, options),) = fixture.sent
    assert (topic, options) == (BASE + "desc", {"qos": 1, "retain": True})
    return codec.decode(payload, Description)


def test_a_retained_message_that_some_brokers_reject_is_not_sent(fixture: Fixture) -> None:
    rest = len(codec.encode(Twin(device="", bodies=())))
    fixture.publisher.publish_description(Twin(device="x" * (codec.MAX_RETAINED_BYTES - rest), bodies=()))
    assert len(fixture.sent[-1][1]) == codec.MAX_RETAINED_BYTES
    with pytest.raises(ProtocolError):
        fixture.publisher.publish_description(Twin(device="x" * codec.MAX_RETAINED_BYTES, bodies=()))


def test_events_are_also_recorded(fixture: Fixture) -> None:
    fixture.publisher.publish_event(EventRecord(EventKind.STOP_RESET, "on", "info", {}, 7))
    assert [(event.device, event.kind, event.at_ms) for event in fixture.recorded] == [("arm", "stop-reset", 7)]


def test_a_description_that_was_not_published_is_not_updated(fixture: Fixture) -> None:
    fixture.publisher.update_description()
    assert fixture.sent == []


def test_the_description_has_the_data_of_robot_type_and_device(fixture: Fixture) -> None:
    fixture.publisher.scripts = SandboxStatus("unconfined", "no seccomp" * 1000)
    description = described(fixture)
    shared = {"kind", "joints", "mimic_joints", "position_dependent_limits", "frames", "capabilities", "streams"}
    for name in (*shared, "cameras"):
        value = getattr(NAO, name)
        assert value, f"{name} of the example is empty"
        assert codec.encode(getattr(description, name)) == codec.encode(value)
    assert (description.device, description.robot_type, description.label) == ("arm", "nao", "Arm")
    for names in ("postures", "expressions", "behaviours"):
        assert getattr(description, names) == tuple(getattr(NAO, names)) != ()
    assert (description.actions, description.limits) == (("move_joints",), ("speed",))
    assert (description.interlocks, description.simulated, description.streaming) == ((INTERLOCK,), True, False)
    assert (description.watchdog_ms, description.max_loop_age_ms) == (300, 200)
    assert (description.captures, description.controls, description.diagnostics) == ((), (), ())
    assert description.position_m is None
    assert description.base is not None
    assert NAO.base is not None
    assert description.base.forward_m_s == NAO.base.max_linear_m_s
    assert (description.scripts, len(description.scripts_note)) == ("unconfined", 2000)


@pytest.mark.usefixtures("clock")
def test_the_description_of_a_room_device_has_the_data_of_its_manifest() -> None:
    room = RoomDeviceManifest(
        name="arm",
        kind="camera",
        label="Camera",
        driver="none",
        cameras=CAMERAS,
        captures=("image",),
        controls=CONTROLS,
        diagnostics=NAO.diagnostics,
        position_m=(1.0, 2.0, 3.0),
    )
    description = described(Fixture(room.robot_type(), room))
    for name in ("cameras", "captures", "controls", "diagnostics", "position_m"):
        assert getattr(description, name)
        assert codec.encode(getattr(description, name)) == codec.encode(getattr(room, name))
    assert description.base is None


def test_a_connection_publishes_the_twin_and_makes_the_state_due(fixture: Fixture) -> None:
    fixture.publisher.publish_state(SNAPSHOT)
    fixture.publisher.publish_description(TWIN)
    assert [topic.removeprefix(BASE) for topic, _, _ in fixture.sent] == ["state", "desc", "desc/twin"]
    _, payload, options = fixture.sent[-1]
    assert (codec.decode(payload, Twin), options) == (TWIN, {"qos": 1, "retain": True})
    fixture.publisher.publish_state(SNAPSHOT)
    assert len(fixture.states()) == 2


def test_the_state_has_all_data_of_the_device(fixture: Fixture, clock: SimpleNamespace) -> None:
    fixture.publisher.publish_frame("front", FRAME)
    fixture.publisher.publish_telemetry("climate", MEASURED)
    clock.now_s += WINDOW_S
    for _ in range(20):
        fixture.publisher.publish_frame("front", FRAME)
        fixture.publisher.publish_telemetry("climate", MEASURED)
    fixture.publisher.publish_state(SNAPSHOT)
    (state,) = fixture.states()
    lease = LeaseState(
        holder="ann",
        epoch=7,
        expires_in_ms=12_000 - round(WINDOW_S * 1000),
        reason="repair",
        request=OpenRequest(id="r1", requester="bob", expires_in_ms=0),
    )
    assert state == State(
        device="arm",
        at_ms=2000,
        tick_ms=30,
        mode=Mode.ACTION,
        epoch=7,
        ended_epoch=6,
        stop=SNAPSHOT.latch,
        lease=lease,
        action=SNAPSHOT.action,
        faults=SNAPSHOT.faults,
        restrictions=SNAPSHOT.restrictions,
        stiffness={"elbow": 0.5},
        rates_hz={"cam/front": 20 / WINDOW_S, "tele/climate": 20 / WINDOW_S},
    )
    assert fixture.sent[-1][2] == {"qos": 1, "retain": True}


@pytest.mark.parametrize(
    ("lease", "request_", "shown"),
    [
        (None, SNAPSHOT.control_request, None),
        (SNAPSHOT.lease, None, LeaseState(holder="ann", epoch=7, expires_in_ms=12_000, reason="repair")),
        (
            SNAPSHOT.lease,
            SNAPSHOT.control_request,
            LeaseState(
                holder="ann",
                epoch=7,
                expires_in_ms=12_000,
                reason="repair",
                request=OpenRequest(id="r1", requester="bob", expires_in_ms=3_500),
            ),
        ),
        (Lease("ann", 7, 999.0), None, LeaseState(holder="ann", epoch=7, expires_in_ms=0)),
    ],
)
def test_the_state_shows_lease_and_request_only_if_there_is_one(
    fixture: Fixture, lease: Lease | None, request_: ControlRequest | None, shown: LeaseState | None
) -> None:
    fixture.publisher.publish_state(replace(SNAPSHOT, lease=lease, control_request=request_))
    assert fixture.states()[0].lease == shown


@pytest.mark.parametrize(
    ("change", "after_s"),
    [
        ({}, 30.0),
        ({"load": 1}, 1.0),
        ({"action": ActionState(id="c1", kind="move_joints", progress=0.9)}, 30.0),
        ({"action": ActionState(id="c2", kind="move_joints")}, 1.0),
        ({"faults": (Fault(code="driver", message="no answer", since_ms=3, count=2),)}, 30.0),
        ({"faults": (Fault(code="driver", message="no power", since_ms=3),)}, 1.0),
        ({"mode": Mode.IDLE}, 1.0),
        ({"ended": 7}, 1.0),
    ],
)
def test_a_change_is_published_after_a_second_and_everything_after_thirty(
    fixture: Fixture, clock: SimpleNamespace, change: dict[str, Any], after_s: float
) -> None:
    fixture.publisher.publish_state(SNAPSHOT)
    changed = replace(SNAPSHOT, **change)
    clock.now_s += after_s - 0.01
    fixture.publisher.publish_state(changed)
    assert len(fixture.states()) == 1
    clock.now_s += 0.01
    fixture.publisher.publish_state(changed)
    assert len(fixture.states()) == 2


def test_an_urgent_change_is_published_at_once_and_an_unchanged_state_is_not(fixture: Fixture) -> None:
    fixture.publisher.publish_state(SNAPSHOT)
    fixture.publisher.publish_state(SNAPSHOT, urgent=True)
    fixture.publisher.publish_state(replace(SNAPSHOT, mode=Mode.IDLE), urgent=True)
    assert [state.mode for state in fixture.states()] == [Mode.ACTION, Mode.IDLE]


def test_under_load_the_state_is_published_every_five_seconds(fixture: Fixture, clock: SimpleNamespace) -> None:
    loaded = replace(SNAPSHOT, load=2)
    for _ in range(10):
        fixture.publisher.publish_state(loaded)
        clock.now_s += 1.0
    assert [state.load for state in fixture.states()] == [2, 2]


def test_a_state_that_could_not_be_sent_is_published_again(fixture: Fixture) -> None:
    fixture.accepts = False
    fixture.publisher.publish_state(SNAPSHOT)
    fixture.accepts = True
    fixture.publisher.publish_state(SNAPSHOT)
    assert len(fixture.states()) == 1


@pytest.mark.parametrize("accepts", [True, False])
def test_telemetry_is_sent_once_and_offered_to_the_outbox(fixture: Fixture, accepts: bool) -> None:
    fixture.accepts = accepts
    fixture.publisher.publish_telemetry("climate", MEASURED)
    payload = codec.encode(MEASURED)
    assert fixture.sent == ([(BASE + "tele/climate", payload, {"qos": 0})] if accepts else [])
    options = {"at_ms": 9, "sent": accepts, "now_s": 1000.0}
    assert fixture.stored == [(BASE + "late/climate", payload, options)]


def test_a_frame_is_sent_once(fixture: Fixture) -> None:
    fixture.publisher.publish_frame("front", FRAME)
    ((topic, payload, options),) = fixture.sent
    assert (topic, decode(payload), options) == (BASE + "cam/front", FRAME, {"qos": 0})


def test_an_event_is_given_to_the_outbox(fixture: Fixture) -> None:
    record = EventRecord(EventKind.MOTION_HELD, "m" * 3000, "warning", {"code": "x"}, 77)
    fixture.publisher.publish_event(record)
    ((topic, payload, options),) = fixture.stored
    event = codec.decode(payload, Event)
    assert (topic, options) == (BASE + "event", {"at_ms": 77})
    assert (event.device, event.at_ms, event.kind, event.severity) == ("arm", 77, EventKind.MOTION_HELD, "warning")
    assert (event.message, event.data) == ("m" * 2000, {"code": "x"})
    assert event.id


def test_rejections_are_counted_by_code(fixture: Fixture) -> None:
    for code in ("a", "b", "a"):
        fixture.publisher.count_rejection(code)
    assert fixture.publisher.rejections == {"a": 2, "b": 1}
