"""Broker access of a share, and the end of a share."""

from typing import Any, NamedTuple

import pytest

from device_agent.protocol import CancelAction, GrantLease, MoveJoints, ReleaseLease, topics
from function_app.domain.identity.accounts import Identity, Role
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.crash_injection import elsewhere
from tests.harness.network.brokers import wait_until
from tests.unit.function_app.services.sharing.shares import SHARED_S, Three, devices, share, steering, unshare, watching


def test_watching_a_shared_device_hears_that_device_alone(cloud: Cloud, broker: MemoryBroker, three: Three) -> None:
    anna, bert, robot = three
    with paired(cloud, "anna", "arm", "leg") as (_, second):
        share(anna, f"devices/{second.device}", bert, "operator")
        page, issued = watching(broker, bert)
        base = f"ts/v1/{second.space}/{second.id}/arm"
        spoken = ("desc", "desc/twin", "state", "tele/+", "cam/+", "event", "ack")
        wanted = {topics.conn(second.space, second.id), *(f"{base}/{kind}" for kind in spoken)}
        assert set(issued["subscribe"]) == wanted
        assert issued["publish"] == [f"{base}/stop"]
        with page:
            assert page.subscribe(*issued["subscribe"][:8]) == [1] * 8
            for topic in (f"{base}/#", f"ts/v1/{second.space}/{second.id}/leg/state"):
                assert page.subscribe(topic) == [128], topic
            robot.say(robot.topic(topics.EVENT), {"x": 1})
            second.say(second.topic(topics.EVENT, "leg"), {"x": 2})
            second.say(second.topic(topics.EVENT, "arm"), {"x": 3})
            while (message := page.receive()).topic.endswith("/conn"):
                pass
            assert message.topic == f"{base}/event"
            page.publish(f"{base}/stop", b'{"id":"s1","caller":"bert"}')
            wait_until(lambda: second.stops, "the Stop")


def test_watching_a_shared_space_is_said_by_space(three: Three) -> None:
    anna, bert, robot = three
    for role, stops in (("viewer", 0), ("operator", 1)):
        share(anna, f"spaces/{robot.space}", bert, role, expires_in_s=60)
        issued = bert.post("/mqtt/credentials", {"purpose": "view"}).json()
        assert f"ts/v1/{robot.space}/{robot.id}/arm/state" in issued["subscribe"]
        assert len(issued["publish"]) == stops
        assert 50 <= issued["lifetime_s"] <= 60, "credentials end with the share"


def test_more_devices_than_fit_into_one_grant_are_left_out(cloud: Cloud, broker: MemoryBroker, three: Three) -> None:
    anna, bert, _ = three
    with cloud.robot(*(f"device-with-a-long-name-{n:02d}" for n in range(30))) as many:
        many.pair(anna)
        for device in many.devices:
            share(anna, f"devices/{device}", bert, "operator")
        page, issued = watching(broker, bert)
        page.close()
        assert 10 <= len(issued["publish"]) < 30
        share(anna, f"spaces/{many.space}", bert, "viewer")
        heard = bert.post("/mqtt/credentials", {"purpose": "view"}).json()["subscribe"]
        assert sum(topic.endswith("/state") for topic in heard) == 31


class Busy(NamedTuple):
    """Bert operates Anna's robot: a lease, a running action and one that waits."""

    anna: Person
    bert: Person
    robot: Robot
    epoch: int
    running: str
    waiting: str


@pytest.fixture
def busy(three: Three) -> Busy:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=SHARED_S)
    epoch = bert.take(robot.device, lease_ms=600_000).json()["epoch"]
    running = bert.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
    waiting = bert.start(robot.device, epoch=epoch, policy="queue").json()["id"]
    return Busy(anna, bert, robot, epoch, running, waiting)


def expect_the_end(busy: Busy) -> None:
    anna, bert, robot, epoch, running, waiting = busy
    for action in (running, waiting):
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", "unshared")
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert [command.epoch for command in robot.heard(ReleaseLease)] == [epoch + 1], "the epoch is burned"
    assert [command.request.action for command in robot.heard(CancelAction)] == [running]  # type: ignore[union-attr]
    assert [command.id for command in robot.heard(MoveJoints)] == [running]
    problem(bert.take(robot.device, epoch=epoch), 404, "device-unknown")
    problem(bert.start(robot.device, epoch=epoch), 404, "device-unknown")
    assert anna.take(robot.device).json()["epoch"] == epoch + 2
    kinds = [item["kind"] for item in anna.get(f"/devices/{robot.device}/events").json()["items"]]
    assert {"control-ended", "unshared"} <= set(kinds)


def test_unsharing_ends_lease_actions_and_broker_sessions_at_once(broker: MemoryBroker, busy: Busy) -> None:
    anna, bert, robot, epoch, *_ = busy
    page, _ = watching(broker, bert)
    hers, _ = watching(broker, anna)
    with page, hers, steering(broker, bert, robot.device, epoch) as stick:
        unshare(anna, f"devices/{robot.device}", bert)
        for client in (page, stick):
            wait_until(client.disconnected.is_set, "the cut")
        assert not hers.disconnected.is_set()
    expect_the_end(busy)


def test_the_end_of_its_time_ends_it_the_same_way(broker: MemoryBroker, busy: Busy) -> None:
    anna, bert, robot, epoch, *_ = busy
    page, _ = watching(broker, bert)
    cloud = anna.cloud
    with page, steering(broker, bert, robot.device, epoch) as stick:
        cloud.clock.advance(SHARED_S)
        problem(bert.get(f"/devices/{robot.device}"), 404, "device-unknown")
        cloud.sweep()
        for client in (page, stick):
            wait_until(client.disconnected.is_set, "the cut")
    kinds = [item["kind"] for item in anna.get(f"/devices/{robot.device}/events").json()["items"]]
    assert "unshared" in kinds
    assert [anna.action(action)["reason"]["code"] for action in (busy.running, busy.waiting)] == ["unshared"] * 2


def test_a_share_that_is_extended_at_its_very_end_goes_on(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, three: Three
) -> None:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=SHARED_S)
    cloud.clock.advance(SHARED_S)
    sharing, who = cloud.functions.sharing, Identity(anna.account, anna.name, anna.session)
    real = sharing._reminders.schedule
    times = 0

    async def meanwhile(what: str, due_ms: int) -> Any:
        nonlocal times
        times += 1
        if times == 1:
            shared = await sharing.of(who, "device", robot.device)
            await sharing.put(who, shared, await sharing.person("bert"), Role.OPERATOR, None)
        return await real(what, due_ms)

    monkeypatch.setattr(sharing._reminders, "schedule", meanwhile)
    cloud.sweep()
    assert times > 1
    assert devices(bert) == {robot.device: "operator"}


def test_less_than_before_ends_what_is_over_the_new_role(broker: MemoryBroker, busy: Busy) -> None:
    anna, bert, robot, epoch, running, waiting = busy
    page, _ = watching(broker, bert)
    with page, steering(broker, bert, robot.device, epoch) as stick:
        share(anna, f"devices/{robot.device}", bert, "viewer")
        for client in (page, stick):
            wait_until(client.disconnected.is_set, "the cut")
    assert bert.action(running)["reason"]["code"] == "unshared"
    assert bert.action(waiting)["reason"]["code"] == "unshared"
    problem(bert.take(robot.device), 403, "forbidden")
    assert devices(bert) == {robot.device: "viewer"}


def test_who_may_operate_by_another_share_goes_on(busy: Busy) -> None:
    anna, bert, robot, epoch, running, _ = busy
    share(anna, f"spaces/{robot.space}", bert, "operator")
    unshare(anna, f"devices/{robot.device}", bert)
    assert bert.take(robot.device, epoch=epoch).json()["epoch"] == epoch
    assert bert.action(running)["status"] == "started"
    assert robot.heard(ReleaseLease) == []
    unshare(anna, f"spaces/{robot.space}", bert)
    expect_the_end(busy)


def test_unsharing_takes_nothing_from_anybody_else(cloud: Cloud, three: Three, broker: MemoryBroker) -> None:
    anna, bert, robot = three
    clara = cloud.sign_in("clara")
    for person in (bert, clara):
        share(anna, f"devices/{robot.device}", person, "operator")
    with paired(cloud, "bert") as (again, own):
        mine = again.take(own.device).json()["epoch"]
        epoch = clara.take(robot.device, lease_ms=600_000).json()["epoch"]
        page, _ = watching(broker, clara)
        with page, steering(broker, again, own.device, mine) as stick:
            unshare(anna, f"devices/{robot.device}", bert)
            assert clara.take(robot.device, epoch=epoch).json()["epoch"] == epoch
            assert not page.disconnected.is_set()
            assert not stick.disconnected.is_set(), "his own robot follows him on"
    assert robot.heard(ReleaseLease) == []


def test_a_lease_is_not_granted_for_longer_than_the_share(three: Three) -> None:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=60)
    assert bert.take(robot.device, lease_ms=600_000).json()["lease_ms"] <= 60_000
    (grant,) = robot.heard(GrantLease)
    assert isinstance(grant.request, GrantLease)
    assert grant.request.lease_ms <= 60_000


def test_what_the_broker_could_not_be_told_the_timer_tells_it(
    cloud: Cloud, open_cloud: Any, broker: MemoryBroker, busy: Busy
) -> None:
    anna, bert, robot, epoch, *_ = busy
    away = elsewhere(open_cloud(clock=cloud.clock), anna)
    page, _ = watching(broker, bert)
    with page, steering(broker, bert, robot.device, epoch) as stick:
        broker.reachable = False
        assert away.delete(f"/devices/{robot.device}/shares/{bert.account}").status_code == 202
        broker.reachable = True
        assert not page.disconnected.is_set()
        cloud.clock.advance(11)
        cloud.sweep()
        for client in (page, stick):
            wait_until(client.disconnected.is_set, "the cut")
    wait_until(lambda: robot.heard(ReleaseLease), "the end of control")
    assert robot.heard(ReleaseLease)[-1].epoch == epoch + 1
