"""Acquiring, renewing, losing and releasing control of a device."""

import pytest

from device_agent.protocol import GrantLease, ReleaseLease
from device_agent.protocol.security import setpoints
from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, problem


def test_a_lease_is_acquired_confirmed_renewed_and_released(anna: Person, robot: Robot) -> None:
    path = f"/devices/{robot.device}/lease"
    acquired = anna.take_lease(robot.device, lease_ms=5_000).json()
    assert (acquired["epoch"], acquired["holder"], acquired["lease_ms"]) == (1, "anna", 5_000)
    assert acquired["confirmed"] is True
    (grant,) = robot.received(GrantLease)
    assert isinstance(grant.request, GrantLease)
    pairing = grant.request.pairing
    assert (grant.epoch, grant.caller, grant.request) == (
        1,
        "anna",
        GrantLease(holder="anna", lease_ms=5_000, pairing=pairing),
    )
    renewed = anna.take_lease(robot.device, epoch=1, lease_ms=60_000).json()
    assert (renewed["epoch"], renewed["confirmed"]) == (1, True)
    assert renewed["expires_at"] > acquired["expires_at"]
    shown = anna.get(f"/devices/{robot.device}").json()["lease"]
    owner = {"holder": "anna", "holder_account": anna.account}
    expected = {**owner, "epoch": 1, "expires_at": renewed["expires_at"], "mine": True}
    assert shown == {**expected, "reason": "", "request": None}
    assert anna.get(path).json() == {"lease": shown}
    assert anna.delete(f"{path}?epoch=1").status_code == 204
    assert [(command.epoch, command.caller) for command in robot.received(ReleaseLease)] == [(1, "anna")]
    assert anna.get(path).json() == {"lease": None}
    problem(anna.delete(f"{path}?epoch=1"), 409, "lease-lost")
    assert anna.post(path).json()["lease_ms"] == 30_000
    assert [anna.take_lease(robot.device).json()["epoch"] for _ in range(3)] == [3, 4, 5]
    problem(anna.take_lease(robot.device, epoch=4), 409, "lease-lost")
    assert anna.take_lease(robot.device, epoch=5).json()["epoch"] == 5


def test_a_renewal_schedules_no_check_for_events(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks: list[str] = []

    async def schedule_check(device: str) -> None:
        checks.append(device)

    monkeypatch.setattr(cloud.functions.control_events, "schedule_check", schedule_check)
    anna.take_lease(robot.device)
    assert checks == [robot.device]
    anna.take_lease(robot.device, epoch=1)
    assert checks == [robot.device]


def test_a_lease_excludes_other_sessions_until_it_expires(cloud: Cloud, anna: Person, robot: Robot) -> None:
    elsewhere = cloud.sign_in("anna")
    path = f"/devices/{robot.device}/lease"
    acquired = anna.take_lease(robot.device, lease_ms=1_000).json()
    refusal = problem(elsewhere.take_lease(robot.device), 409, "lease-held")
    assert (refusal["holder"], refusal["expires_at"], refusal["mine"]) == ("anna", acquired["expires_at"], False)
    problem(elsewhere.take_lease(robot.device, epoch=1), 409, "lease-lost")
    problem(elsewhere.delete(f"{path}?epoch=1"), 409, "lease-lost")
    assert elsewhere.get(path).json()["lease"]["mine"] is False
    cloud.clock.advance(1)
    assert anna.get(path).json() == {"lease": None}
    lost = problem(anna.take_lease(robot.device, epoch=1), 409, "lease-lost")
    assert (lost["epoch"], lost["current_epoch"]) == (1, 1)
    problem(anna.delete(f"{path}?epoch=1"), 409, "lease-lost")
    assert elsewhere.take_lease(robot.device).json()["epoch"] == 2
    assert problem(anna.take_lease(robot.device, epoch=1), 409, "lease-lost")["current_epoch"] == 2


def test_a_lease_ends_although_the_clock_is_set_back(cloud: Cloud, anna: Person, robot: Robot) -> None:
    anna.take_lease(robot.device, lease_ms=1_000)
    cloud.clock.advance(-30)
    problem(cloud.sign_in("anna").take_lease(robot.device), 409, "lease-held")
    cloud.clock.advance(-3600)
    elsewhere = cloud.sign_in("anna")
    assert elsewhere.take_lease(robot.device).json()["epoch"] == 2


def test_a_lease_is_unconfirmed_without_an_ack_of_the_robot(anna: Person, robot: Robot) -> None:
    robot.silent = True
    assert anna.take_lease(robot.device, wait_ms=100).json()["confirmed"] is False
    assert anna.take_lease(robot.device, wait_ms=0).json()["confirmed"] is False
    call = anna.begin("POST", f"/devices/{robot.device}/lease", json={"wait_ms": 20_000})
    robot.fail(robot.received(GrantLease)[2].id, "stopped", "Reset it first.")
    answer = call().json()
    assert answer.pop("expires_at")
    assert answer.pop("setpoint_key")
    assert answer == {"epoch": 3, "holder": "anna", "lease_ms": 30_000, "confirmed": False, "streaming": True}


def test_the_holder_gets_the_key_that_the_agent_derives_from_the_grant(anna: Person, robot: Robot) -> None:
    keys = []
    for number, epoch in enumerate((None, 1, None)):
        answer = anna.take_lease(robot.device, epoch=epoch)
        assert answer.headers["cache-control"] == "no-store"
        grant = robot.received(GrantLease)[number]
        assert isinstance(grant.request, GrantLease)
        (cloud_key,) = robot._keys.values()
        topic = f"ts/v1/{robot.space}/{robot.id}/arm/ctl/{grant.epoch}"
        key = setpoints.lease_key(robot.key, cloud_key, topic=topic, pairing=grant.request.pairing)
        assert answer.json()["setpoint_key"] == key.hex()
        keys.append(key)
    assert keys[0] == keys[1] != keys[2], "a renewal keeps the key, a new lease has another one"
    assert "setpoint_key" not in str(anna.get(f"/devices/{robot.device}/lease").json())


def test_invalid_requests_are_refused(anna: Person, robot: Robot) -> None:
    limits = (("lease_ms", 999), ("lease_ms", 600_001), ("epoch", 0), ("epoch", 2**53 + 1), ("wait_ms", -1))
    for field, value in (*limits, ("wait_ms", 30_001), ("holder", "me")):
        problem(anna.take_lease(robot.device, **{field: value}), 422, "invalid")
    assert anna.get(f"/devices/{robot.device}/lease").json() == {"lease": None}
    for query in ("", "?epoch=x", "?epoch=0"):
        problem(anna.delete(f"/devices/{robot.device}/lease{query}"), 422, "invalid")


def test_releasing_ends_the_connection_for_setpoints(anna: Person, robot: Robot, broker: MemoryBroker) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    body = {"purpose": "control", "device": robot.device, "epoch": epoch}
    issued = anna.post("/mqtt/credentials", body).json()
    with broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"])) as client:
        assert client.connected.is_set()
        anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}")
        assert client.disconnected.is_set()
