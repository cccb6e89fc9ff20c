"""Broker credentials contain exactly the topics that the caller may use (see also tests/security/tenants)."""

import pytest

from device_agent.protocol import topics
from function_app.domain.common.timestamps import rfc3339
from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.harness.cloud.cloud import Cloud, Person, paired, problem

VIEWED = ("desc", "desc/twin", "state", "tele/+", "cam/+", "event", "ack")


def connect(broker: MemoryBroker, issued: dict[str, str]) -> MemoryConnection:
    client = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert client.connected.is_set(), client.answer
    return client


def received(robot: Robot) -> list[str]:
    """Topics of the messages that the robot received since the last call."""
    assert robot.link is not None
    return [message.topic for message in robot.link.pending()]


def test_viewing_covers_every_device_of_the_account_and_no_other(
    cloud: Cloud, broker: MemoryBroker, anna: Person, robot: Robot
) -> None:
    with paired(cloud, "anna", "left", "right") as (_, second), paired(cloud, "bert") as (_, foreign):
        before_s = cloud.clock.now_ms() // 1000
        answer = anna.post("/mqtt/credentials", {"purpose": "view"})
        after_s = cloud.clock.now_ms() // 1000
        issued = answer.json()
        assert answer.headers["cache-control"] == "no-store"
        bases = [f"ts/v1/{each.space}/{each.id}/{name}" for each in (robot, second) for name in each.names]
        conns = [topics.conn(each.space, each.id) for each in (robot, second)]
        subscribe = [*conns, *(f"{base}/{kind}" for base in bases for kind in VIEWED)]
        assert sorted(issued["subscribe"]) == sorted(subscribe)
        assert sorted(issued["publish"]) == sorted(f"{base}/stop/{anna.account}" for base in bases)
        tcp = {"host": "127.0.0.1", "port": 1, "tls": False, "certificate_after_ms": None}
        assert (issued["lifetime_s"], issued["tcp"]) == (900, tcp)
        assert issued["expires_at"] in {rfc3339((now_s + 900) * 1000) for now_s in (before_s, after_s)}
        with connect(broker, issued) as page:
            assert page.subscribe(*subscribe) == [1] * len(subscribe)
            page.subscribe(topics.conn(foreign.space, foreign.id), f"ts/v1/{foreign.space}/#", "ts/v1/#")
            page.pending()
            foreign.publish(foreign.topic(topics.EVENT), {"x": 1})
            robot.publish(robot.topic(topics.EVENT), {"x": 2})
            second.publish(second.topic(topics.EVENT, "right"), {"x": 3})
            expected = [robot.topic(topics.EVENT), second.topic(topics.EVENT, "right")]
            assert [message.topic for message in page.pending()] == expected
            received(robot)
            page.publish(f"{bases[0]}/stop/{anna.account}", b'{"id":"s1"}')
            for kind in ("ctl/1", "cmd", "state", "stop", "stop/another"):
                page.publish(f"{bases[0]}/{kind}", b"{}")
            assert received(robot) == [f"{bases[0]}/stop/{anna.account}"]
            assert robot.stops


def test_control_covers_the_setpoints_of_its_epoch_only(broker: MemoryBroker, anna: Person, robot: Robot) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    issued = anna.post("/mqtt/credentials", {"purpose": "control", "device": robot.device, "epoch": epoch}).json()
    base = f"ts/v1/{robot.space}/{robot.id}/arm"
    assert (issued["publish"], issued["subscribe"]) == ([f"{base}/ctl/{epoch}"], [])
    assert issued["lifetime_s"] == 60
    received(robot)
    with connect(broker, issued) as page:
        for kind in (f"ctl/{epoch}", f"ctl/{epoch + 1}", "stop", "cmd", "ack"):
            page.publish(f"{base}/{kind}", b"{}")
    assert received(robot) == [f"{base}/ctl/{epoch}"]


def test_control_requires_the_current_lease(cloud: Cloud, anna: Person, robot: Robot) -> None:
    body = {"purpose": "control", "device": robot.device}
    problem(anna.post("/mqtt/credentials", {**body, "epoch": 1}), 409, "lease-lost")
    epoch = anna.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
    assert anna.post("/mqtt/credentials", {**body, "epoch": epoch}).json()["lifetime_s"] == 600
    for person, value in ((anna, epoch + 1), (cloud.sign_in("anna"), epoch)):
        problem(person.post("/mqtt/credentials", {**body, "epoch": value}), 409, "lease-lost")
    problem(cloud.sign_in("bert").post("/mqtt/credentials", {**body, "epoch": epoch}), 404, "device-unknown")
    cloud.clock.advance(600)
    problem(anna.post("/mqtt/credentials", {**body, "epoch": epoch}), 409, "lease-lost")


def test_a_device_of_a_polling_agent_gives_a_reason_for_rejected_setpoints(anna: Person, robot: Robot) -> None:
    assert anna.take_lease(robot.device).json()["streaming"]
    assert robot.enroll(transport="http").status_code == 200
    lease = anna.post(f"/devices/{robot.device}/lease", {"take_over": True, "reason": "test", "wait_ms": 0}).json()
    assert not lease["streaming"]
    assert not anna.get(f"/devices/{robot.device}").json()["streaming"]
    body = {"purpose": "control", "device": robot.device, "epoch": lease["epoch"]}
    rejection = problem(anna.post("/mqtt/credentials", body), 409, "streaming-unavailable")
    assert "polls over HTTP" in rejection["detail"]
    (event, *_) = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert event["data"]["code"] == "streaming-unavailable"


def test_an_agent_gets_its_own_devices(robot: Robot) -> None:
    issued = robot.request("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
    own = f"ts/v1/{robot.space}/{robot.id}"
    assert (issued["client_id"], issued["lifetime_s"]) == (robot.id, 3600)
    assert sorted(issued["subscribe"]) == sorted([f"{own}/+/cmd", f"{own}/+/ctl/+", f"{own}/+/stop/+"])
    published = ("desc", "state", "event", "ack", "desc/+", "tele/+", "late/+", "cam/+")
    assert sorted(issued["publish"]) == sorted([f"{own}/conn", *(f"{own}/+/{kind}" for kind in published)])


def test_people_and_agents_cannot_use_each_others_purposes(cloud: Cloud, anna: Person, robot: Robot) -> None:
    problem(anna.post("/mqtt/credentials", {"purpose": "agent"}), 401, "unauthorized")
    for body in ({"purpose": "view"}, {"purpose": "control", "device": robot.device, "epoch": 1}):
        problem(robot.request("POST", "/mqtt/credentials", json=body), 401, "unauthorized")
    problem(cloud.robot().request("POST", "/mqtt/credentials", json={"purpose": "agent"}), 401, "unauthorized")


def test_an_account_without_devices_may_view_nothing(cloud: Cloud, broker: MemoryBroker) -> None:
    issued = cloud.sign_in("clara").post("/mqtt/credentials", {"purpose": "view"}).json()
    assert (issued["publish"], issued["subscribe"]) == ([], [])
    with connect(broker, issued) as client:
        assert client.subscribe("ts/v1/#") == [128]


@pytest.mark.parametrize("body", [{}, {"purpose": "root"}, {"purpose": "control"}, {"purpose": "view", "device": "x"}])
def test_invalid_purposes_are_refused(cloud: Cloud, body: dict[str, str]) -> None:
    problem(cloud.sign_in("anna").post("/mqtt/credentials", body), 422, "invalid")


def test_a_shared_device_may_be_viewed_and_stopped_without_its_space(anna: Person, bert: Person, robot: Robot) -> None:
    share = {"account": "bert", "role": "operator"}
    assert anna.post(f"/devices/{robot.device}/shares", share).status_code in {200, 201}
    issued = bert.post("/mqtt/credentials", {"purpose": "view"}).json()
    base = f"ts/v1/{robot.space}/{robot.id}/arm"
    assert issued["publish"] == [f"{base}/stop/{bert.account}"]
    assert {f"{base}/{kind}" for kind in VIEWED} <= set(issued["subscribe"])
