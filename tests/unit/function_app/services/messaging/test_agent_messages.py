"""Messages that an agent sends over HTTP are ingested as over MQTT; other callers are refused."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from device_agent.protocol import AckStatus, Event, Measurements, Mode, State, codec, topics
from function_app.entrypoints.ingest.router import ingest
from function_app.ports.broker_access import Credentials
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.polling import PollingRobot


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Iterator[PollingRobot]:
    """A paired agent that has not polled yet."""
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        yield robot


def state(tick_ms: int = 1) -> bytes:
    return codec.encode(State(device="arm", at_ms=1, tick_ms=tick_ms, mode=Mode.IDLE, epoch=0))


class TestMessages:
    def test_each_message_has_its_own_result(self, anna: Person, robot: PollingRobot, cloud: Cloud) -> None:
        other = cloud.robot()
        other.pair(cloud.sign_in("bert"))
        own = f"ts/v1/{robot.space}/{robot.id}"
        good = [(robot.topic(topics.STATE), state(7)), (f"{own}/conn", b'{"online":true,"session":3,"at_ms":1}')]
        foreign = [
            other.topic(topics.STATE),
            f"ts/v1/{other.space}/{robot.id}/arm/state",
            f"ts/v1/{robot.space}/{other.id}/arm/state",
            f"{own}/leg/state",
            f"{own}/arm/cmd",
            f"{own}/arm/stop/account",
            f"{own}/arm/ctl/1",
            f"{own}/arm/cam/wrist",
            f"{own}/arm/tele",
            f"{own}/+/state",
            "$CONTROL/telescope/v1",
            "x",
        ]
        bad = [
            (robot.topic(topics.STATE), b"[]"),
            (robot.topic(topics.STATE), b'{"device":"arm"}'),
            (robot.topic(topics.EVENT), b'{"id":"e","device":"arm","at_ms":1,"kind":"","severity":"odd","message":""}'),
            (robot.topic(topics.ACK), codec.encode(robot.ack(f"{other.device}-{'0' * 20}", AckStatus.DONE))),
            (robot.topic(topics.ACK), codec.encode(robot.ack("x", AckStatus.DONE))),
            (robot.topic(topics.TELE) + "/heat", b'{"values":1}'),
        ]
        answer = robot.post_raw(*good, *((topic, state(8)) for topic in foreign), *bad)
        assert answer.status_code == 200, answer.text
        results = answer.json()["results"]
        assert [result["status"] for result in results] == ["stored"] * 2 + ["rejected"] * (len(foreign) + len(bad))
        assert all(result["detail"].endswith(".") for result in results[2:])
        assert anna.get(f"/devices/{robot.device}").json()["state"]["tick_ms"] == 7

    def test_duplicate_messages_are_stored_once(self, anna: Person, robot: PollingRobot) -> None:
        robot.fetch()
        action = anna.start(robot.device).json()["id"]
        acks = [
            (robot.topic(topics.ACK), codec.encode(robot.ack(action, status)))
            for status in (AckStatus.RECEIVED, AckStatus.STARTED, AckStatus.DONE)
        ]
        event = Event(id="e1", device="arm", at_ms=1, kind="bump", severity="info", message="")
        messages = [*acks, (robot.topic(topics.EVENT), codec.encode(event)), (robot.topic(topics.STATE), state())]
        for _ in range(2):
            assert {result["status"] for result in robot.post_raw(*messages).json()["results"]} == {"stored"}
            assert anna.action(action)["status"] == "done"
        assert len(anna.get(f"/devices/{robot.device}/events").json()["items"]) == 1

    def test_messages_are_relayed_to_the_broker_and_its_echo_is_ignored(
        self, cloud: Cloud, broker: MemoryBroker, anna: Person, robot: PollingRobot
    ) -> None:
        def page() -> MemoryConnection:
            issued = anna.post("/mqtt/credentials", {"purpose": "view"}).json()
            client = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
            client.subscribe(robot.topic(topics.STATE), robot.topic(topics.TELE) + "/+", robot.topic(topics.EVENT))
            return client

        event = codec.encode(Event(id="e1", device="arm", at_ms=1, kind="bump", severity="info", message=""))
        heat = codec.encode(Measurements(tick_ms=1, at_ms=cloud.clock.now_ms(), sequence=1, values={"t_c": 20.0}))
        messages = [(robot.topic(topics.STATE), state(n)) for n in (1, 2, 3)]
        messages += [(robot.topic(topics.TELE) + "/heat", heat), (robot.topic(topics.EVENT), event)]
        with page() as subscriber:
            robot.post_raw(*messages, (f"ts/v1/{robot.space}/{robot.id}/arm/cmd", b"{}"))
            received = [subscriber.receive() for _ in messages]
            assert sorted((message.topic, message.payload) for message in received) == sorted(messages)
            states = [message.payload for message in received if message.topic.endswith("/state")]
            assert states == [state(1), state(2), state(3)]
        with page() as late:
            retained = late.receive()
            assert (retained.payload, retained.retain) == (state(3), True)
        cloud.run(ingest(cloud.functions, robot.topic(topics.STATE), state(2)))
        assert anna.get(f"/devices/{robot.device}").json()["state"]["tick_ms"] == 3

    def test_relaying_pauses_while_the_broker_is_unreachable(
        self, broker: MemoryBroker, robot: PollingRobot, caplog: pytest.LogCaptureFixture
    ) -> None:
        broker.reachable = False
        for number in range(50):
            assert robot.post_raw((robot.topic(topics.STATE), state(number))).status_code == 200
        assert caplog.text.count("relayed messages are not published") == 1


class TestRefusals:
    def test_messages_before_the_claim_are_refused(self, cloud: Cloud) -> None:
        robot = PollingRobot(cloud)
        robot.enroll()
        problem(robot.poll(), 409, "agent-unclaimed")
        problem(robot.post(("t", {})), 409, "agent-unclaimed")

    def test_requests_beyond_the_limits_are_refused(self, robot: PollingRobot) -> None:
        for query in ({"wait_ms": -1}, {"wait_ms": 30_001}, {"limit": 0}, {"limit": 33}, {"have": ["x"] * 33}):
            problem(robot.poll(**query), 422, "invalid")
        problem(robot.post(), 422, "invalid")
        problem(robot.post(*[("t", 1)] * 501), 422, "invalid")
        problem(robot.post_raw((robot.topic(topics.STATE), b'"' + b"x" * 1_000_000 + b'"')), 413, "too-large")
        problem(robot.post_raw((robot.topic(topics.STATE), b"[" * 10_000 + b"]" * 10_000)), 422, "invalid")
        (result,) = robot.post_raw((robot.topic(topics.STATE), b'"' + b"x" * 140_000 + b'"')).json()["results"]
        assert result["status"] == "rejected"

    def test_a_new_owner_gets_no_earlier_commands(self, cloud: Cloud, anna: Person, robot: PollingRobot) -> None:
        robot.fetch()
        anna.start(robot.device, ttl_ms=600_000, timeout_ms=600_000)
        anna.post(f"/devices/{robot.device}/stop")
        assert len(robot.fetch()) == 2
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        problem(robot.poll(), 409, "agent-unclaimed")
        for owner in (cloud.sign_in("bert"), anna):
            robot.pair(owner)
            assert robot.fetch() == []
            assert owner.delete(f"/agents/{robot.id}").status_code == 204


INVALID_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(min_value=-(10**40), max_value=10**40)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(categories=None), max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=8,
)
MESSAGES: list[dict[str, Any]] = [
    {"online": True, "session": 1, "at_ms": 1, "software": ""},
    {"device": "arm", "at_ms": 1, "tick_ms": 1, "mode": "idle", "epoch": 0, "faults": []},
    {"id": "e", "device": "arm", "at_ms": 1, "kind": "k", "severity": "info", "message": "", "data": {}},
    {"device": "arm", "kind": "arm", "robot_type": "ur5", "label": "", "joints": [], "streams": []},
    {"id": "", "status": "done", "sequence": 1, "at_ms": 1, "tick_ms": 1, "output": "", "result": {}},
    {"tick_ms": 1, "at_ms": 1, "sequence": 1, "values": {"t_c": 1.0}},
]
"""One message of each class; the test replaces some fields with random values."""


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_every_message_is_stored_or_refused(
    cloud: Cloud, anna: Person, robot: PollingRobot, data: st.DataObject
) -> None:
    arm = ("state", "event", "desc", "ack", "tele/heat", "tele/joints", "desc/twin")
    kinds = ["conn", *(f"arm/{kind}" for kind in arm)]
    messages = []
    for _ in range(data.draw(st.integers(1, 4))):
        message = dict(data.draw(st.sampled_from(MESSAGES)))
        for name in data.draw(st.lists(st.sampled_from(sorted(message)), max_size=2, unique=True)):
            message[name] = data.draw(INVALID_VALUES)
        if message.get("id") == "":
            message["id"] = f"{robot.device}-{'0' * 20}"
        topic = f"ts/v1/{robot.space}/{robot.id}/{data.draw(st.sampled_from(kinds))}"
        messages.append((topic, json.dumps(message).encode()))
    answer = robot.post_raw(*messages)
    assert answer.status_code in {200, 422}, answer.text
    if answer.status_code == 200:
        assert len(answer.json()["results"]) == len(messages)
    assert anna.get(f"/devices/{robot.device}").status_code == 200
    assert anna.get(f"/devices/{robot.device}/data").status_code == 200
    cloud.sweep()
