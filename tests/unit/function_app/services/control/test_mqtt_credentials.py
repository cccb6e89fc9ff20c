"""Broker credentials: exactly the topics that are written down, for exactly those who may."""

import pytest

from device_agent.protocol import topics
from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.network.brokers import PATIENCE_S, SILENCE_S, wait_until

Pair = tuple[Person, Robot]
WATCHED = ("desc", "desc/twin", "state", "tele/+", "cam/+", "event", "ack")


def connect(broker: MemoryBroker, issued: dict[str, str]) -> MemoryConnection:
    client = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert client.connected.is_set(), client.answer
    return client


def try_to_publish(broker: MemoryBroker, issued: dict[str, str], topic: str) -> None:
    """Returns once the broker has dealt with it: the embedded one ends the connection, mosquitto drops the message."""
    with connect(broker, issued) as client:
        mid = client.publish(topic, b"{}")
        wait_until(lambda: client.disconnected.is_set() or client.acknowledged(mid), "an answer")


def test_watching_hears_every_device_of_the_account_and_no_other(
    cloud: Cloud, broker: MemoryBroker, pair: Pair
) -> None:
    anna, robot = pair
    with paired(cloud, "anna", "left", "right") as (_, second), paired(cloud, "bert") as (_, foreign):
        answer = anna.post("/mqtt/credentials", {"purpose": "view"})
        issued = answer.json()
        assert answer.headers["cache-control"] == "no-store"
        bases = [f"ts/v1/{each.space}/{each.id}/{name}" for each in (robot, second) for name in each.names]
        conns = [topics.conn(each.space, each.id) for each in (robot, second)]
        assert sorted(issued["subscribe"]) == sorted(
            [*conns, *(f"{base}/{kind}" for base in bases for kind in WATCHED)]
        )
        assert sorted(issued["publish"]) == sorted(f"{base}/stop" for base in bases)
        assert (issued["lifetime_s"], issued["tcp"]) == (
            900,
            {"host": "127.0.0.1", "port": 1, "tls": False, "certificate_after_ms": None},
        )
        with connect(broker, issued) as page:
            for start in range(0, len(issued["subscribe"]), 8):
                chunk = issued["subscribe"][start : start + 8]
                assert page.subscribe(*chunk) == [1] * len(chunk)
            page.subscribe(topics.conn(foreign.space, foreign.id), f"ts/v1/{foreign.space}/#", "ts/v1/#")
            foreign.say(foreign.topic(topics.EVENT), {"x": 1})
            robot.say(robot.topic(topics.EVENT), {"x": 2})
            second.say(second.topic(topics.EVENT, "right"), {"x": 3})
            heard = {page.receive().topic}
            while len(heard & {robot.topic(topics.EVENT), second.topic(topics.EVENT, "right")}) < 2:
                heard.add(page.receive(PATIENCE_S).topic)
            heard |= {message.topic for message in page.pending()}
            assert not [topic for topic in heard if foreign.space in topic]
            page.publish(f"{bases[0]}/stop", b'{"id":"s1","caller":"anna"}')
            wait_until(lambda: robot.stops, "the Stop")
        assert robot.link is not None
        robot.link.pending()
        for topic in (f"{bases[0]}/ctl/1", f"{bases[0]}/cmd", f"{bases[0]}/state"):
            try_to_publish(broker, issued, topic)
        with pytest.raises(AssertionError, match="received nothing"):
            robot.link.receive(SILENCE_S)


def test_control_sends_this_epochs_setpoints_and_nothing_else(broker: MemoryBroker, pair: Pair) -> None:
    anna, robot = pair
    epoch = anna.take(robot.device).json()["epoch"]
    issued = anna.post("/mqtt/credentials", {"purpose": "control", "device": robot.device, "epoch": epoch}).json()
    base = f"ts/v1/{robot.space}/{robot.id}/arm"
    assert (issued["publish"], issued["subscribe"]) == ([f"{base}/ctl/{epoch}"], [])
    assert issued["lifetime_s"] == 60
    assert robot.link is not None
    robot.link.pending()
    with connect(broker, issued) as page:
        page.publish(f"{base}/ctl/{epoch}", b"{}")
        assert robot.link.receive().topic == f"{base}/ctl/{epoch}"
    for kind in (f"ctl/{epoch + 1}", "stop", "cmd", "ack"):
        try_to_publish(broker, issued, f"{base}/{kind}")
    with pytest.raises(AssertionError, match="received nothing"):
        robot.link.receive(SILENCE_S)


def test_control_is_for_the_holder_of_that_epoch(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    ask = {"purpose": "control", "device": robot.device}
    problem(anna.post("/mqtt/credentials", {**ask, "epoch": 1}), 409, "lease-lost")
    epoch = anna.take(robot.device, lease_ms=600_000).json()["epoch"]
    assert anna.post("/mqtt/credentials", {**ask, "epoch": epoch}).json()["lifetime_s"] == 600
    for person, given in ((anna, epoch + 1), (cloud.sign_in("anna"), epoch)):
        problem(person.post("/mqtt/credentials", {**ask, "epoch": given}), 409, "lease-lost")
    problem(cloud.sign_in("bert").post("/mqtt/credentials", {**ask, "epoch": epoch}), 404, "device-unknown")
    cloud.clock.advance(600)
    problem(anna.post("/mqtt/credentials", {**ask, "epoch": epoch}), 409, "lease-lost")


def test_an_agent_speaks_for_its_own_devices(pair: Pair) -> None:
    _, robot = pair
    issued = robot.ask("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
    own = f"ts/v1/{robot.space}/{robot.id}"
    assert (issued["client_id"], issued["lifetime_s"]) == (robot.id, 3600)
    assert sorted(issued["subscribe"]) == sorted([f"{own}/+/cmd", f"{own}/+/ctl/+", f"{own}/+/stop"])
    spoken = ("desc", "state", "event", "ack", "desc/+", "tele/+", "late/+", "cam/+")
    assert sorted(issued["publish"]) == sorted([f"{own}/conn", *(f"{own}/+/{kind}" for kind in spoken)])


def test_a_person_is_no_agent_and_an_agent_no_person(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    problem(anna.post("/mqtt/credentials", {"purpose": "agent"}), 401, "unauthorized")
    for body in ({"purpose": "view"}, {"purpose": "control", "device": robot.device, "epoch": 1}):
        problem(robot.ask("POST", "/mqtt/credentials", json=body), 401, "unauthorized")
    for path in ("/devices", "/accounts/me", "/agents"):
        problem(robot.ask("GET", path), 401, "unauthorized")
    problem(cloud.robot().ask("POST", "/mqtt/credentials", json={"purpose": "agent"}), 401, "unauthorized")


def test_an_account_without_devices_may_watch_nothing(cloud: Cloud, broker: MemoryBroker) -> None:
    issued = cloud.sign_in("clara").post("/mqtt/credentials", {"purpose": "view"}).json()
    assert (issued["publish"], issued["subscribe"]) == ([], [])
    with connect(broker, issued) as client:
        assert client.subscribe("ts/v1/#") == [128]


@pytest.mark.parametrize("body", [{}, {"purpose": "root"}, {"purpose": "control"}, {"purpose": "view", "device": "x"}])
def test_another_purpose_there_is_not(pair: Pair, body: dict[str, str]) -> None:
    problem(pair[0].post("/mqtt/credentials", body), 422, "invalid")
