"""What the API shows of devices: what agents said last, and only what is theirs to say."""

import time
from typing import Any

import pytest

from device_agent.protocol import (
    AckStatus,
    Description,
    Event,
    LeaseState,
    Mode,
    Presence,
    State,
    StopLatch,
    codec,
    topics,
)
from function_app.domain.devices.devices import SILENT_MS
from function_app.entrypoints.ingest.router import ingest
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]


def hear(cloud: Cloud, topic: str, message: Any) -> None:
    """As if the broker had delivered it."""
    payload = message if isinstance(message, bytes) else codec.encode(message)
    cloud.run(ingest(cloud.functions, topic, payload))


def presence(robot: Robot, session: int, *, online: bool) -> tuple[str, Presence]:
    return topics.conn(robot.space, robot.id), Presence(online=online, session=session, at_ms=0)


def state(**changes: Any) -> State:
    return State(device="arm", at_ms=5, tick_ms=6, mode=Mode.IDLE, epoch=3, **changes)


def test_presence_and_state_arrive_over_the_broker(pair: Pair) -> None:
    anna, robot = pair
    stop = StopLatch(caller="anna", reason="test", at_ms=4)
    robot.say_state(state(stop=stop, lease=LeaseState(holder="anna", epoch=3, expires_in_ms=100)))
    wait_until(lambda: anna.get(f"/devices/{robot.device}").json()["state"], "the state")
    shown = anna.get(f"/devices/{robot.device}").json()
    assert shown["state"]["stop"] == {"caller": "anna", "reason": "test", "at_ms": 4}
    assert shown["state"]["lease"]["expires_in_ms"] == 100
    assert shown["online"] is True
    assert shown["last_seen_at"].endswith("Z")
    robot.say_presence(online=False)
    wait_until(lambda: not anna.get(f"/devices/{robot.device}").json()["online"], "offline")


def test_a_will_of_an_earlier_connection_is_old_news(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    hear(cloud, *presence(robot, 7, online=True))
    hear(cloud, *presence(robot, 6, online=False))
    assert anna.get(f"/devices/{robot.device}").json()["online"] is True
    hear(cloud, *presence(robot, 7, online=False))
    hear(cloud, *presence(robot, 7, online=True))
    assert anna.get(f"/devices/{robot.device}").json()["online"] is False
    hear(cloud, *presence(robot, 8, online=True))
    assert anna.get(f"/devices/{robot.device}").json()["online"] is True


def test_a_robot_that_is_silent_for_90_s_is_not_believed_to_be_there(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    cloud.clock.advance(SILENT_MS / 1000 - 10)
    assert anna.get(f"/devices/{robot.device}").json()["online"] is True
    cloud.clock.advance(20)
    assert anna.get(f"/devices/{robot.device}").json()["online"] is False
    hear(cloud, robot.topic(topics.STATE), state())
    assert anna.get(f"/devices/{robot.device}").json()["online"] is True


def test_an_agent_cannot_publish_for_another(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    with paired(cloud, "bert") as (_, other):
        before = anna.get("/devices").json()
        for topic, message in (
            (topics.conn(other.space, robot.id), Presence(online=False, session=99, at_ms=0)),
            (topics.conn("elsewhere", robot.id), Presence(online=False, session=99, at_ms=0)),
            (topics.device(other.space, robot.id, "arm", "state"), state()),
            (topics.device(robot.space, robot.id, "leg", "state"), state()),
            (topics.device(robot.space, "zzzzzzzzzz", "arm", "state"), state()),
            (topics.device(robot.space, robot.id, "arm", "tele", "joints"), state()),
        ):
            hear(cloud, topic, message)
        assert anna.get("/devices").json() == before


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b"\xff", b'{"online":1}', b"[" * 50_000, b"x" * 200_000])
def test_what_is_no_message_is_dropped(cloud: Cloud, pair: Pair, payload: bytes) -> None:
    anna, robot = pair
    before = anna.get("/devices").json()
    for kind in (topics.STATE, topics.DESC, topics.EVENT, topics.ACK):
        hear(cloud, robot.topic(kind), payload)
    hear(cloud, topics.conn(robot.space, robot.id), payload)
    hear(cloud, "some/other/topic", payload)
    assert anna.get("/devices").json() == before


def test_an_event_and_a_description_are_stored_once(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    event = Event(id="e1", device="arm", at_ms=1_700_000_000_000, kind="fault", severity="error", message="hot")
    later = Event(id="e2", device="arm", at_ms=1_700_000_000_001, kind="fault", severity="error", message="hotter")
    description = Description(device="arm", kind="arm", robot_type="ur5", label="Arm")
    for _ in range(3):
        hear(cloud, robot.topic(topics.EVENT), event)
        hear(cloud, robot.topic(topics.EVENT), later)
        hear(cloud, robot.topic(topics.DESC), description)
    page = anna.get(f"/devices/{robot.device}/events").json()
    assert [event["id"] for event in page["items"]] == ["e2", "e1"], "newest first"
    row = cloud.run(cloud.functions.tables.get(records.DESCRIPTIONS, robot.id, "arm"))
    assert row is not None
    assert row.data["label"] == "Arm"


class TestAcks:
    """Acks come doubled, late, out of order and from strangers."""

    def test_doubled_and_disordered_ones_end_as_those_in_order(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        robot.silent = True
        action = anna.start(robot.device).json()["id"]
        life = [
            robot.ack(action, status)
            for status in (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)
        ]
        for number in (2, 0, 2, 3, 1, 3, 0):
            hear(cloud, robot.topic(topics.ACK), life[number])
        hear(cloud, robot.topic(topics.ACK), robot.ack(action, AckStatus.FAILED))
        shown = anna.action(action)
        assert shown["status"] == "done"
        assert {"received_ms", "started_ms", "done_ms"} <= set(shown["times"])
        robot.silent = False
        assert anna.start(robot.device, wait_ms=10_000).status_code == 200, "the slot is free"

    def test_a_late_ack_does_not_free_another_actions_slot(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        first = anna.start(robot.device, wait_ms=10_000).json()["id"]
        done = robot.report(first, AckStatus.DONE)
        wait_until(lambda: anna.action(first)["status"] == "done", "the end")
        second = anna.start(robot.device, wait_ms=10_000).json()["id"]
        hear(cloud, robot.topic(topics.ACK), done)
        assert anna.start(robot.device).json()["action"] == second

    def test_another_agent_cannot_end_it(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        action = anna.start(robot.device, wait_ms=10_000).json()["id"]
        with paired(cloud, "bert") as (_, other):
            done = robot.ack(action, AckStatus.DONE)
            hear(cloud, other.topic(topics.ACK), done)
            other.say(other.topic(topics.ACK), done)
            other.report(action, AckStatus.FAILED)
            time.sleep(0.2)
        assert anna.action(action)["status"] == "started"

    def test_acks_about_nothing_are_dropped(self, cloud: Cloud, pair: Pair) -> None:
        _, robot = pair
        for name in ("x", f"{robot.device}-{'0' * 20}", robot.device):
            hear(cloud, robot.topic(topics.ACK), robot.ack(name, AckStatus.DONE))

    def test_a_result_too_deep_to_be_read_again_does_not_cost_the_end(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        action = anna.start(robot.device, wait_ms=10_000).json()["id"]
        ack = codec.encode(robot.ack(action, AckStatus.DONE))
        deep = b'"result":{"a":' + b"[" * 600 + b"]" * 600 + b"}"
        hear(cloud, robot.topic(topics.ACK), ack.replace(b'"result":{}', deep))
        assert anna.action(action)["status"] == "done"
        assert anna.get(f"/devices/{robot.device}/actions").status_code == 200


def test_a_device_that_is_not_there_is_unknown(pair: Pair) -> None:
    anna, robot = pair
    for device in ("x", f"{robot.id}-leg", f"{robot.id}-", robot.id, "a" * 64, "%00", "..", f"{robot.id}-arm%20"):
        assert anna.get(f"/devices/{device}").status_code == 404
