"""Reading cache: subscriptions, ages and restarts of senders."""

from types import SimpleNamespace

import pytest

from device_agent.protocol import JointTelemetry, Measurements, Mode, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import RESTART_GAP_S, Reading, ReadingCache


@pytest.fixture
def clock() -> SimpleNamespace:
    return SimpleNamespace(now_s=100.0)


@pytest.fixture
def room(clock: SimpleNamespace) -> ReadingCache:
    named = [("sensors-pir", "presence"), ("lamp", "light"), ("sensors-arm", "joints")]
    return ReadingCache(space="lab", agent="own", own=["arm", "lamp"], named=named, clock_s=lambda: clock.now_s)


def measured(sequence: int = 1, *, tick_ms: int = 1, at_ms: int = 1, **values: float) -> Measurements:
    return Measurements(tick_ms=tick_ms, at_ms=at_ms, sequence=sequence, values=values)


def topic(device: str = "pir", stream: str = "presence", *, agent: str = "sensors", space: str = "lab") -> topics.Topic:
    return topics.Topic(space, agent, device, topics.TELE, stream)


def receive(room: ReadingCache, message: Measurements | JointTelemetry, where: topics.Topic | None = None) -> None:
    room.receive(where or topic(), codec.encode(message))


def value(room: ReadingCache) -> float | None:
    reading = room.latest("sensors-pir", "presence")
    return None if reading is None else reading.values["present"]


def test_sources_of_other_agents_are_subscribed_by_exact_topic(room: ReadingCache) -> None:
    assert room.topics() == ("ts/v1/lab/sensors/arm/tele/joints", "ts/v1/lab/sensors/pir/tele/presence")


def test_the_newest_reading_is_given_with_its_age_since_it_arrived(room: ReadingCache, clock: SimpleNamespace) -> None:
    assert room.latest("sensors-pir", "presence") is None
    receive(room, measured(present=1.0, at_ms=2**50))
    clock.now_s += 1.5
    assert room.latest("sensors-pir", "presence") == Reading({"present": 1.0}, 1.5)
    receive(room, measured(2, present=0.0, at_ms=1))
    assert room.latest("sensors-pir", "presence") == Reading({"present": 0.0}, 0.0)


def test_an_own_device_is_named_by_its_name_or_its_id(room: ReadingCache) -> None:
    room.record("lamp", "light", measured(lux=80.0))
    assert room.latest("lamp", "light") == room.latest("own-lamp", "light") == Reading({"lux": 80.0}, 0.0)
    room.record("arm", "heat", measured(t_c=20.0))
    with pytest.raises(Refused, match="own-arm/heat is not subscribed"):
        room.latest("arm", "heat")


def test_joints_are_read_by_index(room: ReadingCache) -> None:
    telemetry = JointTelemetry(
        tick_ms=1,
        at_ms=1,
        sequence=1,
        mode=Mode.IDLE,
        position_rad=(0.5, 1.0),
        velocity_rad_s=(0.0, 0.1),
        effort_nm=(1.0, 2.0),
        commanded_rad=(0.5, 1.0),
    )
    receive(room, telemetry, topic("arm", "joints"))
    reading = room.latest("sensors-arm", "joints")
    assert reading is not None
    assert (reading.values["position_rad.1"], reading.values["effort_nm.0"]) == (1.0, 1.0)


def test_unsubscribed_streams_are_rejected_with_the_subscribed_ones(room: ReadingCache) -> None:
    with pytest.raises(Refused, match=r"add it under \[\[room\]\].*own-lamp/light, sensors-arm/joints") as refused:
        room.latest("sensors-door", "open")
    assert refused.value.code == "unknown_stream"
    with pytest.raises(Refused, match="There are: none"):
        ReadingCache(space="lab", agent="own", own=["arm"]).latest("x-y", "z")


def test_unsubscribed_messages_are_not_stored(room: ReadingCache) -> None:
    for number in range(1000):
        receive(room, measured(present=1.0), topic(f"d{number}"))
    receive(room, measured(present=1.0), topic(space="elsewhere"))
    room.receive(topics.Topic("lab", "sensors", "pir", topics.LATE, "presence"), codec.encode(measured(present=1.0)))
    assert room._received == {}


@pytest.mark.parametrize("payload", [b"", b"{}", b'{"tick_ms":1,"at_ms":1,"sequence":1,"values":{"present":NaN}}'])
def test_malformed_measurements_change_nothing(room: ReadingCache, payload: bytes) -> None:
    receive(room, measured(present=0.0))
    with pytest.raises(ProtocolError):
        room.receive(topic(), payload)
    assert value(room) == 0.0


def test_overtaken_messages_are_dropped_but_a_restarted_sender_is_accepted(
    room: ReadingCache, clock: SimpleNamespace
) -> None:
    receive(room, measured(7, tick_ms=700, present=1.0))
    receive(room, measured(6, tick_ms=600, present=0.0))
    receive(room, measured(7, tick_ms=700, present=0.0))
    assert value(room) == 1.0
    receive(room, measured(1, tick_ms=900, present=2.0))
    assert value(room) == 2.0, "the sending agent restarted"
    clock.now_s += RESTART_GAP_S
    receive(room, measured(1, tick_ms=5, present=3.0))
    assert value(room) == 3.0, "the sending machine restarted"
