"""The end of control fences the former holder at the broker and at the device, within a deadline."""

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from device_agent.protocol import Mode, ReleaseLease, State
from function_app.domain.devices.devices import Device
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.cloud.memory import Memory
from tests.unit.function_app.services.sharing.shares import connected, share

DEADLINE_S = 2.0


@pytest.fixture
def device(cloud: Cloud, robot: Robot) -> Device:
    """The robot, as its owner sees it."""
    device = cloud.run(cloud.functions.devices.get_as_owner(robot.device))
    assert device is not None
    return device


def revoke(cloud: Cloud, device: Device, **options: Any) -> bool:
    async def call() -> bool:
        until_s = asyncio.get_running_loop().time() + DEADLINE_S
        return await cloud.functions.revocation.revoke(device, "unshared", **{"until_s": until_s, **options})

    return cloud.run(call())


def retry(cloud: Cloud, device: Device, person: Person) -> bool:
    async def call() -> bool:
        until_s = asyncio.get_running_loop().time() + DEADLINE_S
        return await cloud.functions.revocation.retry(device, person.account, until_s=until_s)

    return cloud.run(call())


def take_lease(person: Person, robot: Robot) -> dict[str, Any]:
    """Take control and return the fields of a request for setpoint credentials."""
    return {"device": robot.device, "epoch": person.take_lease(robot.device, lease_ms=600_000).json()["epoch"]}


@pytest.fixture
def slow_broker(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    """The broker closes connections after 60 s."""
    real = cloud.functions.access.revoke

    async def slow(**options: Any) -> None:
        await asyncio.sleep(60)
        await real(**options)

    monkeypatch.setattr(cloud.functions.access, "revoke", slow)


def test_broker_and_device_are_notified_again_after_an_outage(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker, device: Device
) -> None:
    control = take_lease(anna, robot)
    with connected(broker, anna) as viewer, connected(broker, anna, "control", **control) as operator:
        broker.reachable = False
        assert not revoke(cloud, device)
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None, "the lease has ended in any case"
        assert not retry(cloud, device, anna)
        assert not operator.disconnected.is_set()
        broker.reachable = True
        assert retry(cloud, device, anna)
        assert [each.disconnected.is_set() for each in (viewer, operator)] == [False, True]
    (release,) = robot.received(ReleaseLease)
    assert (release.epoch, release.caller) == (control["epoch"] + 1, "telescope")


def test_all_connections_of_the_account_are_closed_if_another_account_has_control_now(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot, broker: MemoryBroker, *, device: Device
) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    control = take_lease(anna, robot)
    with connected(broker, anna, "control", **control) as holder, connected(broker, bert) as former:
        broker.reachable = False
        assert not retry(cloud, device, bert)
        broker.reachable = True
        assert retry(cloud, device, bert)
        assert [each.disconnected.is_set() for each in (holder, former)] == [False, True]
    assert robot.received(ReleaseLease) == []


@pytest.mark.usefixtures("slow_broker")
def test_notifications_end_at_the_deadline(cloud: Cloud, anna: Person, robot: Robot, device: Device) -> None:
    take_lease(anna, robot)
    begin_s = cloud.loop.time()
    assert not revoke(cloud, device)
    assert not retry(cloud, device, anna)
    take_lease(anna, robot)
    assert not retry(cloud, device, anna)
    assert cloud.loop.time() - begin_s == pytest.approx(3 * DEADLINE_S)


@pytest.mark.usefixtures("slow_broker")
def test_without_a_deadline_the_broker_is_awaited(cloud: Cloud, anna: Person, robot: Robot, device: Device) -> None:
    take_lease(anna, robot)
    assert revoke(cloud, device, until_s=None)


@pytest.mark.parametrize("case", ["no lease", "free", "other account", "other pairing"])
def test_only_a_lease_of_the_account_and_pairing_ends(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker, *, device: Device, case: str
) -> None:
    if case != "no lease":
        control = take_lease(anna, robot)
    if case == "free":
        anna.delete(f"/devices/{robot.device}/lease?epoch={control['epoch']}")
        robot.commands.clear()
    options = {"account": "x"} if case == "other account" else {}
    broker.reachable = False  # a notification would fail
    assert revoke(cloud, _of_pairing(device, case), **options)
    broker.reachable = True
    assert (anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None) == (case in {"no lease", "free"})
    assert robot.received(ReleaseLease) == []


@pytest.mark.parametrize("case", ["no lease", "other pairing"])
def test_there_is_nothing_to_repeat_without_a_lease_of_the_pairing(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker, *, device: Device, case: str
) -> None:
    if case != "no lease":
        take_lease(anna, robot)
    with connected(broker, anna) as viewer:
        assert retry(cloud, _of_pairing(device, case), anna)
        assert not viewer.disconnected.is_set()
    assert robot.received(ReleaseLease) == []


def test_the_end_of_control_is_recorded_for_the_owner(
    cloud: Cloud, anna: Person, robot: Robot, memory: Memory, device: Device
) -> None:
    control = take_lease(anna, robot)
    assert revoke(cloud, device, account=anna.account)
    epoch = control["epoch"] + 1
    memory.tables.drop(records.AGENTS)  # the agent was deleted before the event is published
    cloud.run(cloud.functions.control_events.publish(robot.device))
    (record, *_) = anna.get("/accounts/me/audit").json()["items"]
    assert (record["event"], record["target"]) == ("control-ended", robot.device)
    assert record["data"].items() >= {"epoch": epoch, "holder": "anna", "reason": "unshared"}.items()


@pytest.mark.parametrize(("reported", "epoch"), [(1, 4), (3, 4), (20, 21)])
def test_the_epoch_is_above_those_of_lease_and_device(  # noqa: PLR0917 (fixtures and parameters)
    cloud: Cloud, anna: Person, robot: Robot, device: Device, reported: int, epoch: int
) -> None:
    for _ in range(3):
        take_lease(anna, robot)
    cloud.sign_in("anna").post(f"/devices/{robot.device}/lease/requests", {})
    now_ms = cloud.clock.now_ms()
    robot.publish_state(State(device="arm", at_ms=now_ms, tick_ms=1, mode=Mode.IDLE, epoch=reported, ended_epoch=0))
    assert revoke(cloud, device)
    assert [command.epoch for command in robot.received(ReleaseLease)] == [epoch]
    assert anna.take_lease(robot.device).json()["epoch"] == epoch + 1


def test_a_failed_cut_is_reported(cloud: Cloud, broker: MemoryBroker, device: Device) -> None:
    for reachable in (True, False):
        broker.reachable = reachable
        assert cloud.run(cloud.functions.revocation.cut(device, 1)) is reachable


def _of_pairing(device: Device, case: str) -> Device:
    return replace(device, pairing="other") if case == "other pairing" else device
