"""Taking, renewing, losing and giving back control of a device."""

import pytest

from device_agent.protocol import AckStatus, GrantLease, ReleaseLease
from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]


def test_a_lease_is_taken_confirmed_renewed_and_released(pair: Pair) -> None:
    anna, robot = pair
    taken = anna.take(robot.device, lease_ms=5_000).json()
    assert (taken["epoch"], taken["holder"], taken["lease_ms"], taken["confirmed"]) == (1, "anna", 5_000, True)
    (grant,) = robot.heard(GrantLease)
    assert (grant.epoch, grant.request) == (1, GrantLease(holder="anna", lease_ms=5_000))
    renewed = anna.take(robot.device, epoch=1, lease_ms=60_000).json()
    assert (renewed["epoch"], renewed["confirmed"]) == (1, True)
    assert renewed["expires_at"] > taken["expires_at"]
    shown = anna.get(f"/devices/{robot.device}").json()["lease"]
    assert shown == {
        "holder": "anna",
        "epoch": 1,
        "expires_at": renewed["expires_at"],
        "mine": True,
        "reason": "",
        "request": None,
    }
    assert anna.get(f"/devices/{robot.device}/lease").json() == {"lease": shown}
    assert anna.delete(f"/devices/{robot.device}/lease?epoch=1").status_code == 204
    wait_until(lambda: robot.heard(ReleaseLease), "the release")
    assert robot.heard(ReleaseLease)[0].epoch == 1
    assert anna.get(f"/devices/{robot.device}/lease").json() == {"lease": None}


def test_taking_without_an_epoch_always_gives_the_next_one(pair: Pair) -> None:
    anna, robot = pair
    assert [anna.take(robot.device).json()["epoch"] for _ in range(3)] == [1, 2, 3]
    problem(anna.take(robot.device, epoch=2), 409, "lease-lost")
    assert anna.take(robot.device, epoch=3).json()["epoch"] == 3


def test_another_session_is_told_who_holds_it_even_of_the_same_account(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    elsewhere = cloud.sign_in("anna")
    taken = anna.take(robot.device).json()
    refused = problem(elsewhere.take(robot.device), 409, "lease-held")
    assert (refused["holder"], refused["expires_at"], refused["mine"]) == ("anna", taken["expires_at"], False)
    problem(elsewhere.take(robot.device, epoch=1), 409, "lease-lost")
    problem(elsewhere.delete(f"/devices/{robot.device}/lease?epoch=1"), 409, "lease-lost")
    assert elsewhere.get(f"/devices/{robot.device}/lease").json()["lease"]["mine"] is False


def test_a_lease_that_ran_out_is_lost_and_the_next_is_higher(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    elsewhere = cloud.sign_in("anna")
    anna.take(robot.device, lease_ms=1_000)
    cloud.clock.advance(1)
    assert anna.get(f"/devices/{robot.device}/lease").json() == {"lease": None}
    lost = problem(anna.take(robot.device, epoch=1), 409, "lease-lost")
    assert (lost["epoch"], lost["current_epoch"]) == (1, 1)
    problem(anna.delete(f"/devices/{robot.device}/lease?epoch=1"), 409, "lease-lost")
    assert elsewhere.take(robot.device).json()["epoch"] == 2
    assert problem(anna.take(robot.device, epoch=1), 409, "lease-lost")["current_epoch"] == 2


def test_a_released_lease_is_anybodys_with_a_higher_epoch(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    epoch = anna.take(robot.device).json()["epoch"]
    anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}")
    problem(anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}"), 409, "lease-lost")
    assert cloud.sign_in("anna").take(robot.device).json()["epoch"] == epoch + 1


def test_a_robot_that_says_nothing_or_no_has_not_confirmed(pair: Pair) -> None:
    anna, robot = pair
    robot.silent = True
    assert anna.take(robot.device, wait_ms=100).json()["confirmed"] is False
    assert anna.take(robot.device, wait_ms=0).json()["confirmed"] is False
    answer = anna.begin("POST", f"/devices/{robot.device}/lease", json={"wait_ms": 20_000})
    wait_until(lambda: len(robot.heard(GrantLease)) == 3, "the command")
    robot.fail(robot.heard(GrantLease)[2].id, "stopped", "Reset it first.")
    assert answer().json() | {"expires_at": ""} == {
        "epoch": 3,
        "holder": "anna",
        "expires_at": "",
        "lease_ms": 30_000,
        "confirmed": False,
    }


@pytest.mark.parametrize(
    "body",
    [
        {"lease_ms": 999},
        {"lease_ms": 600_001},
        {"epoch": 0},
        {"epoch": 2**53 + 1},
        {"wait_ms": 30_001},
        {"wait_ms": -1},
        {"holder": "me"},
    ],
    ids=str,
)
def test_a_request_out_of_bounds_is_refused(pair: Pair, body: dict[str, object]) -> None:
    anna, robot = pair
    problem(anna.take(robot.device, **body), 422, "invalid")
    assert anna.get(f"/devices/{robot.device}/lease").json() == {"lease": None}
    for query in ("", "?epoch=x", "?epoch=0"):
        problem(anna.delete(f"/devices/{robot.device}/lease{query}"), 422, "invalid")


def test_no_body_takes_it_for_half_a_minute(pair: Pair) -> None:
    anna, robot = pair
    assert anna.post(f"/devices/{robot.device}/lease").json()["lease_ms"] == 30_000


def test_releasing_ends_the_connection_that_carried_the_setpoints(pair: Pair, broker: MemoryBroker) -> None:
    anna, robot = pair
    epoch = anna.take(robot.device).json()["epoch"]
    body = {"purpose": "control", "device": robot.device, "epoch": epoch}
    issued = anna.post("/mqtt/credentials", body).json()
    with broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"])) as client:
        assert client.connected.is_set()
        anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}")
        wait_until(client.disconnected.is_set, "the cut")


def test_a_lease_without_an_end_of_the_action_under_it_stays_after_the_robot_ends_it(pair: Pair) -> None:
    anna, robot = pair
    action = anna.start(robot.device, wait_ms=10_000).json()
    taken = anna.take(robot.device).json()
    assert taken["epoch"] == action["epoch"] + 1, "taken on purpose while an action of one's own runs"
    robot.report(action["id"], AckStatus.DONE)
    wait_until(lambda: anna.action(action["id"])["status"] == "done", "the end")
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"]["epoch"] == taken["epoch"]
