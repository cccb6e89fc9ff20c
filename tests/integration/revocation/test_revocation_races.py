"""A share that ends during a request of its operator."""

import itertools
from typing import Any, Literal

import pytest

from device_agent.protocol import GrantLease, MoveJoints, ReleaseLease
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.network.brokers import BROKERS, RunningBroker, wait_until


async def end_share(anna: Person, bert: Person, robot: Robot) -> None:
    sharing, identity = anna.cloud.functions.sharing, Identity(anna.account, anna.name, anna.session)
    await sharing.end(identity, await sharing.of(identity, "device", robot.device), bert.account)


def unshare_at(
    monkeypatch: pytest.MonkeyPatch, operator: tuple[Person, Person, Robot], moment: Literal["checked", "written"]
) -> None:
    """End the share during an operator's request: after the role check or after the write."""
    anna, bert, robot = operator
    functions = anna.cloud.functions
    target, name = {
        "checked": (functions.start_action._reminders, "schedule"),
        "written": (functions.devices, "require_still_allowed"),
    }[moment]
    original = getattr(target, name)
    calls = itertools.count()

    async def meanwhile(*args: Any, **kwargs: Any) -> Any:
        if next(calls) == 0:
            await end_share(anna, bert, robot)
        return await original(*args, **kwargs)

    monkeypatch.setattr(target, name, meanwhile)


@pytest.mark.parametrize("moment", ["checked", "written"])
def test_an_action_that_starts_while_the_share_ends_never_reaches_the_device(
    monkeypatch: pytest.MonkeyPatch, operator: tuple[Person, Person, Robot], moment: Literal["checked", "written"]
) -> None:
    anna, bert, robot = operator
    unshare_at(monkeypatch, operator, moment)
    problem(bert.start(robot.device, wait_ms=1_000), 404, "device-unknown")
    (action,) = anna.get(f"/devices/{robot.device}/actions").json()["items"]
    assert (action["status"], action["reason"]["code"]) == ("failed", "unshared")
    assert robot.received(MoveJoints) == []
    assert anna.start(robot.device, wait_ms=10_000).json()["status"] == "started"


def test_a_lease_acquired_while_the_share_ends_is_not_granted(
    monkeypatch: pytest.MonkeyPatch, operator: tuple[Person, Person, Robot]
) -> None:
    anna, bert, robot = operator
    unshare_at(monkeypatch, operator, "written")
    problem(bert.take_lease(robot.device), 404, "device-unknown")
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    wait_until(
        lambda: [command.epoch for command in robot.received(ReleaseLease)] == [2], "the end of the lease at the robot"
    )
    assert robot.received(GrantLease) == []
    assert anna.take_lease(robot.device).json()["epoch"] == 3


def test_control_is_not_passed_to_an_operator_whose_share_ends(
    monkeypatch: pytest.MonkeyPatch, operator: tuple[Person, Person, Robot]
) -> None:
    anna, bert, robot = operator
    anna.take_lease(robot.device)
    at = f"/devices/{robot.device}/lease/requests"
    request = bert.post(at, {}).json()["request"]["id"]
    unshare_at(monkeypatch, operator, "written")
    problem(anna.post(f"{at}/{request}/accept"), 409, "requester-offline")
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert [command.request.holder for command in robot.received(GrantLease)] == ["anna"]  # type: ignore[union-attr]


@pytest.mark.parametrize("broker", BROKERS, indirect=True)
def test_credentials_issued_while_the_share_ends_are_invalid(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, broker: RunningBroker, operator: tuple[Person, Person, Robot]
) -> None:
    anna, bert, robot = operator
    access, issued = cloud.functions.access, []
    original = access.issue

    async def issue(grant: Any) -> Any:
        credentials = await original(grant)
        issued.append((grant, credentials))
        if len(issued) == 1:
            await end_share(anna, bert, robot)
        return credentials

    monkeypatch.setattr(access, "issue", issue)
    problem(bert.post("/mqtt/credentials", {"purpose": "view"}), 503, "busy")
    ((grant, credentials),) = issued
    with broker.connect(grant.client_id, credentials) as client:
        assert not client.connected.is_set()


def test_an_action_of_a_former_operator_is_not_resent(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, operator: tuple[Person, Person, Robot]
) -> None:
    anna, bert, robot = operator

    async def killed(*_: Any) -> None:
        raise Problem("killed", 500, "Killed", "Killed.")

    with monkeypatch.context() as patch:
        patch.setattr(cloud.functions.start_action, "_require_still_allowed", killed)
        assert bert.start(robot.device).status_code == 500
    (action,) = anna.get(f"/devices/{robot.device}/actions").json()["items"]
    assert action["status"] == "created"
    tables: Any = cloud.functions.tables
    tables._run("DELETE FROM rows WHERE tab = 'Shares'")
    cloud.clock.advance(5)
    cloud.sweep()
    assert anna.action(action["id"])["status"] == "unknown"
    assert robot.received(MoveJoints) == []
    cloud.clock.advance(10)
    cloud.sweep()
    ended = anna.action(action["id"], wait_ms=10_000)
    assert (ended["status"], ended["reason"]["code"]) == ("failed", "unshared"), "the device has not started it"
