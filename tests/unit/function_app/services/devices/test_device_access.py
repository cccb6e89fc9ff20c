"""The API returns the newest messages of devices, to authorized accounts only."""

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


def ingest_message(cloud: Cloud, topic: str, message: Any) -> None:
    """Ingest a message as if the broker had delivered it."""
    payload = message if isinstance(message, bytes) else codec.encode(message)
    cloud.run(ingest(cloud.functions, topic, payload))


def state(**changes: Any) -> State:
    return State(device="arm", at_ms=5, tick_ms=6, mode=Mode.IDLE, epoch=3, **changes)


def online(person: Person, robot: Robot) -> bool:
    return bool(person.get(f"/devices/{robot.device}").json()["online"])


def test_presence_and_state_are_shown(anna: Person, robot: Robot) -> None:
    stop = StopLatch(caller="anna", reason="test", at_ms=4)
    robot.publish_state(state(stop=stop, lease=LeaseState(holder="anna", epoch=3, expires_in_ms=100)))
    shown = anna.get(f"/devices/{robot.device}").json()
    assert shown["state"]["stop"] == {"caller": "anna", "reason": "test", "at_ms": 4, "verified": False}
    assert shown["state"]["lease"]["expires_in_ms"] == 100
    assert shown["online"] is True
    assert shown["last_seen_at"].endswith("Z")
    robot.publish_presence(online=False)
    assert not online(anna, robot)


def test_presence_of_earlier_connections_is_ignored(cloud: Cloud, anna: Person, robot: Robot) -> None:
    steps = ((7, True, True), (6, False, True), (7, False, False), (7, True, False), (8, True, True))
    for session, present, expected in steps:
        ingest_message(cloud, topics.conn(robot.space, robot.id), Presence(online=present, session=session, at_ms=0))
        assert online(anna, robot) is expected


def test_a_silent_robot_is_offline_after_90_s(cloud: Cloud, anna: Person, robot: Robot) -> None:
    cloud.clock.advance(SILENT_MS / 1000 - 10)
    assert online(anna, robot)
    cloud.clock.advance(20)
    assert not online(anna, robot)
    ingest_message(cloud, robot.topic(topics.STATE), state())
    assert online(anna, robot)


def test_an_agent_cannot_publish_for_another(cloud: Cloud, anna: Person, robot: Robot) -> None:
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
            ingest_message(cloud, topic, message)
        assert anna.get("/devices").json() == before


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b"\xff", b'{"online":1}', b"[" * 50_000, b"x" * 200_000])
def test_invalid_messages_are_dropped(cloud: Cloud, anna: Person, robot: Robot, payload: bytes) -> None:
    before = anna.get("/devices").json()
    for kind in (topics.STATE, topics.DESC, topics.EVENT, topics.ACK):
        ingest_message(cloud, robot.topic(kind), payload)
    ingest_message(cloud, topics.conn(robot.space, robot.id), payload)
    ingest_message(cloud, "some/other/topic", payload)
    assert anna.get("/devices").json() == before


def test_an_event_and_a_description_are_stored_once(cloud: Cloud, anna: Person, robot: Robot) -> None:
    description = Description(device="arm", kind="arm", robot_type="ur5", label="Arm")
    for _ in range(3):
        for number in (1, 2):
            at_ms = 1_700_000_000_000 + number
            event = Event(id=f"e{number}", device="arm", at_ms=at_ms, kind="fault", severity="error", message="hot")
            ingest_message(cloud, robot.topic(topics.EVENT), event)
        ingest_message(cloud, robot.topic(topics.DESC), description)
    items = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert [item["id"] for item in items] == ["e2", "e1"], "newest first"
    row = cloud.run(cloud.functions.tables.get(records.DESCRIPTIONS, robot.id, "arm"))
    assert row is not None
    assert row.data["label"] == "Arm"


class TestAcks:
    """Acks may be duplicated, late, out of order or from another agent."""

    def test_order_and_duplicates_do_not_matter(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        robot.silent = True
        action = anna.start(robot.device).json()["id"]
        statuses = (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)
        acks = [robot.ack(action, status) for status in statuses]
        for number in (2, 0, 2, 3, 1, 3, 0):
            ingest_message(cloud, robot.topic(topics.ACK), acks[number])
        ingest_message(cloud, robot.topic(topics.ACK), robot.ack(action, AckStatus.FAILED))
        shown = anna.action(action)
        assert shown["status"] == "done"
        assert {"received_ms", "started_ms", "done_ms"} <= set(shown["times"])
        robot.silent = False
        second = anna.start(robot.device, wait_ms=10_000).json()["id"]
        ingest_message(cloud, robot.topic(topics.ACK), acks[3])
        assert anna.start(robot.device).json()["action"] == second, "a late ack does not free another action's slot"

    def test_foreign_and_unknown_acks_are_ignored(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        action = anna.start(robot.device, wait_ms=10_000).json()["id"]
        with paired(cloud, "bert") as (_, other):
            done = robot.ack(action, AckStatus.DONE)
            ingest_message(cloud, other.topic(topics.ACK), done)
            other.publish(other.topic(topics.ACK), done)
            other.report(action, AckStatus.FAILED)
        for name in ("x", f"{robot.device}-{'0' * 20}", robot.device):
            ingest_message(cloud, robot.topic(topics.ACK), robot.ack(name, AckStatus.DONE))
        assert anna.action(action)["status"] == "started"

    def test_a_deeply_nested_result_does_not_prevent_the_end(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        action = anna.start(robot.device, wait_ms=10_000).json()["id"]
        ack = codec.encode(robot.ack(action, AckStatus.DONE))
        deep = b'"result":{"a":' + b"[" * 600 + b"]" * 600 + b"}"
        ingest_message(cloud, robot.topic(topics.ACK), ack.replace(b'"result":{}', deep))
        assert anna.action(action)["status"] == "done"
        assert anna.get(f"/devices/{robot.device}/actions").status_code == 200


def test_missing_and_foreign_devices_are_indistinguishable(cloud: Cloud, anna: Person, robot: Robot) -> None:
    action = anna.start(robot.device, wait_ms=10_000).json()["id"]
    bert, unknown = cloud.sign_in("bert"), "zzzzzzzzzz"
    for foreign, missing in (
        (f"/devices/{robot.device}", f"/devices/{unknown}-arm"),
        (f"/actions/{action}", f"/actions/{unknown}-arm-{action[-20:]}"),
        (f"/devices/{robot.device}/actions", f"/devices/{unknown}-arm/actions"),
    ):
        one, two = bert.get(foreign).json(), bert.get(missing).json()
        assert one["detail"].replace(robot.id, unknown) == two["detail"]
        assert {**one, "detail": ""} == {**two, "detail": ""}
    for device in ("x", f"{robot.id}-leg", f"{robot.id}-", robot.id, "a" * 64, "%00", "..", f"{robot.id}-arm%20"):
        assert anna.get(f"/devices/{device}").status_code == 404


def test_a_cursor_of_another_account_reveals_nothing(cloud: Cloud, anna: Person) -> None:
    with paired(cloud, "anna"), paired(cloud, "bert") as (bert, other):
        cursor = anna.get("/devices", params={"limit": 1}).json()["cursor"]
        assert cursor is not None
        items = bert.get("/devices", params={"cursor": cursor}).json()["items"]
    assert {item["id"] for item in items} <= {other.device}
