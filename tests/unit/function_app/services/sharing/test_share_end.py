"""Broker access of a share, and the end of a share."""

from typing import Any, NamedTuple

import pytest

from device_agent.protocol import AckStatus, CancelAction, MoveJoints, ReleaseLease, topics
from function_app.domain.identity.accounts import Identity, Role
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.crash_injection import at_instance
from tests.unit.function_app.services.sharing.shares import SHARED_S, connected, devices, share, unshare


def test_viewing_credentials_of_a_shared_device_cover_only_that_device(
    cloud: Cloud, broker: MemoryBroker, anna: Person, bert: Person, robot: Robot
) -> None:
    with paired(cloud, "anna", "arm", "leg") as (_, second):
        share(anna, f"devices/{second.device}", bert, "operator")
        issued = bert.post("/mqtt/credentials", {"purpose": "view"}).json()
        base = f"ts/v1/{second.space}/{second.id}/arm"
        classes = ("desc", "desc/twin", "state", "tele/+", "cam/+", "event", "ack")
        expected = {topics.conn(second.space, second.id), *(f"{base}/{kind}" for kind in classes)}
        assert set(issued["subscribe"]) == expected
        assert issued["publish"] == [f"{base}/stop/{bert.account}"]
        with connected(broker, bert) as page:
            assert page.subscribe(*issued["subscribe"][:8]) == [1] * 8
            for topic in (f"{base}/#", f"ts/v1/{second.space}/{second.id}/leg/state"):
                assert page.subscribe(topic) == [128], topic
            robot.publish(robot.topic(topics.EVENT), {"x": 1})
            second.publish(second.topic(topics.EVENT, "leg"), {"x": 2})
            second.publish(second.topic(topics.EVENT, "arm"), {"x": 3})
            while (message := page.receive()).topic.endswith("/conn"):
                pass
            assert message.topic == f"{base}/event"
            page.publish(f"{base}/stop/{bert.account}", b'{"id":"s1"}')
            assert second.stops


def test_viewing_credentials_of_a_shared_space_follow_role_and_expiry(anna: Person, bert: Person, robot: Robot) -> None:
    for role, stops in (("viewer", 0), ("operator", 1)):
        share(anna, f"spaces/{robot.space}", bert, role, expires_in_s=60)
        issued = bert.post("/mqtt/credentials", {"purpose": "view"}).json()
        assert f"ts/v1/{robot.space}/{robot.id}/arm/state" in issued["subscribe"]
        assert len(issued["publish"]) == stops
        assert 50 <= issued["lifetime_s"] <= 60, "credentials end with the share"


def test_more_devices_than_fit_into_one_grant_are_left_out(cloud: Cloud, anna: Person, bert: Person) -> None:
    with cloud.robot(*(f"device-with-a-long-name-{n:02d}" for n in range(30))) as many:
        many.pair(anna)
        for device in many.devices:
            share(anna, f"devices/{device}", bert, "operator")
        assert 10 <= len(bert.post("/mqtt/credentials", {"purpose": "view"}).json()["publish"]) < 30
        share(anna, f"spaces/{many.space}", bert, "viewer")
        subscribed = bert.post("/mqtt/credentials", {"purpose": "view"}).json()["subscribe"]
        assert sum(topic.endswith("/state") for topic in subscribed) == 31


class Busy(NamedTuple):
    """Bert operates Anna's robot: a lease, a running and a queued action."""

    anna: Person
    bert: Person
    robot: Robot
    epoch: int
    running: str
    waiting: str


@pytest.fixture
def busy(anna: Person, bert: Person, robot: Robot) -> Busy:
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=SHARED_S)
    epoch = bert.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
    running = bert.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
    waiting = bert.start(robot.device, epoch=epoch, policy="queue").json()["id"]
    return Busy(anna, bert, robot, epoch, running, waiting)


def expect_the_end(busy: Busy, status: int = 404, code: str = "device-unknown", event: str = "unshared") -> None:
    anna, bert, robot, epoch, running, waiting = busy
    unreported = anna.action(running)
    assert (unreported["status"], unreported["reason"]["code"]) == ("unknown", "unshared")
    robot.report(running, AckStatus.CANCELLED)
    for action in (running, waiting):
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", "unshared")
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert {command.epoch for command in robot.received(ReleaseLease)} == {epoch + 1}, "the epoch is fenced"
    assert [command.request.action for command in robot.received(CancelAction)] == [running]  # type: ignore[union-attr]
    assert [command.id for command in robot.received(MoveJoints)] == [running]
    problem(bert.take_lease(robot.device, epoch=epoch), status, code)
    problem(bert.start(robot.device, epoch=epoch), status, code)
    assert anna.take_lease(robot.device).json()["epoch"] == epoch + 2
    kinds = [item["kind"] for item in anna.get(f"/devices/{robot.device}/events").json()["items"]]
    assert {"control-ended", event} <= set(kinds)


@pytest.mark.parametrize("how", ["removed", "expired", "lowered"])
def test_the_end_of_a_share_ends_lease_actions_and_broker_sessions(
    cloud: Cloud, broker: MemoryBroker, busy: Busy, how: str
) -> None:
    anna, bert, robot, epoch, *_ = busy
    control = {"device": robot.device, "epoch": epoch}
    with (
        connected(broker, anna) as owner,
        connected(broker, bert) as viewer,
        connected(broker, bert, "control", **control) as operator,
    ):
        if how == "removed":
            unshare(anna, f"devices/{robot.device}", bert)
        elif how == "expired":
            cloud.clock.advance(SHARED_S)
            problem(bert.get(f"/devices/{robot.device}"), 404, "device-unknown")
            cloud.sweep()
        else:
            share(anna, f"devices/{robot.device}", bert, "viewer")
        assert [each.disconnected.is_set() for each in (owner, viewer, operator)] == [False, True, True]
    if how == "lowered":
        expect_the_end(busy, 403, "forbidden", "shared")
    else:
        expect_the_end(busy)


def test_a_share_extended_while_it_expires_remains(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, anna: Person, bert: Person, robot: Robot
) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=SHARED_S)
    cloud.clock.advance(SHARED_S)
    sharing, caller = cloud.functions.sharing, Identity(anna.account, anna.name, anna.session)
    real = sharing._reminders.schedule
    times = 0

    async def meanwhile(what: str, due_ms: int) -> Any:
        nonlocal times
        times += 1
        if times == 1:
            shared = await sharing.of(caller, "device", robot.device)
            await sharing.put(caller, shared, await sharing.person("bert"), Role.OPERATOR, None)
        return await real(what, due_ms)

    monkeypatch.setattr(sharing._reminders, "schedule", meanwhile)
    cloud.sweep()
    assert times > 1
    assert devices(bert) == {robot.device: "operator"}


def test_a_second_share_keeps_lease_and_actions(busy: Busy) -> None:
    anna, bert, robot, epoch, running, _ = busy
    share(anna, f"spaces/{robot.space}", bert, "operator")
    unshare(anna, f"devices/{robot.device}", bert)
    assert bert.take_lease(robot.device, epoch=epoch).json()["epoch"] == epoch
    assert bert.action(running)["status"] == "started"
    assert robot.received(ReleaseLease) == []
    unshare(anna, f"spaces/{robot.space}", bert)
    expect_the_end(busy)


def test_unsharing_does_not_affect_other_accounts(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot, broker: MemoryBroker
) -> None:
    clara = cloud.sign_in("clara")
    for person in (bert, clara):
        share(anna, f"devices/{robot.device}", person, "operator")
    with paired(cloud, "bert") as (again, own):
        mine = again.take_lease(own.device).json()["epoch"]
        epoch = clara.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
        with (
            connected(broker, clara) as page,
            connected(broker, again, "control", device=own.device, epoch=mine) as stick,
        ):
            unshare(anna, f"devices/{robot.device}", bert)
            assert clara.take_lease(robot.device, epoch=epoch).json()["epoch"] == epoch
            assert not page.disconnected.is_set()
            assert not stick.disconnected.is_set(), "the lease on the own robot remains"
    assert robot.received(ReleaseLease) == []


def test_the_timer_completes_a_revocation_after_a_broker_outage(
    cloud: Cloud, open_cloud: Any, broker: MemoryBroker, busy: Busy
) -> None:
    anna, bert, robot, epoch, *_ = busy
    away = at_instance(open_cloud(clock=cloud.clock), anna)
    with connected(broker, bert) as page:
        broker.reachable = False
        assert away.delete(f"/devices/{robot.device}/shares/{bert.account}").status_code == 202
        broker.reachable = True
        assert not page.disconnected.is_set()
        cloud.clock.advance(11)
        cloud.sweep()
        assert page.disconnected.is_set()
    assert robot.received(ReleaseLease)[-1].epoch == epoch + 1
