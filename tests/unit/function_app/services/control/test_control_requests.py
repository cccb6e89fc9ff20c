"""Requests for control are accepted, rejected, withdrawn or expire; an owner may take over."""

from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs

from device_agent.protocol import Command, GrantLease, Mode, ReleaseLease, RequestControl, State, WithdrawRequest
from function_app.domain.identity.accounts import Role
from function_app.ports.broker_access import Credentials
from function_app.ports.tables import StoreError
from function_app.services.devices import device_access
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, problem


@pytest.fixture(autouse=True)
def _lease(anna: Person, robot: Robot) -> None:
    """Anna has control with epoch 1."""
    assert anna.take_lease(robot.device, lease_ms=60_000).json()["epoch"] == 1


@pytest.fixture
def other(cloud: Cloud) -> Person:
    """Another session of Anna's."""
    return cloud.sign_in("anna")


def without_pairing(command: Command) -> GrantLease:
    assert isinstance(command.request, GrantLease)
    return structs.replace(command.request, pairing="")


def request_control(person: Person, robot: Robot, **options: Any) -> Any:
    return person.post(f"/devices/{robot.device}/lease/requests", options)


def create(person: Person, robot: Robot, **options: Any) -> str:
    """Request control and return the path of the request."""
    answer = request_control(person, robot, **options)
    assert answer.status_code == 201, answer.text
    return f"/devices/{robot.device}/lease/requests/{answer.json()['request']['id']}"


def lease(person: Person, robot: Robot) -> Any:
    return person.get(f"/devices/{robot.device}/lease").json()["lease"]


def outcome(person: Person, request: str) -> str:
    return str(person.get(request).json()["outcome"])


def events(person: Person, robot: Robot) -> list[str]:
    """Kinds of control events, oldest first."""
    items = person.get(f"/devices/{robot.device}/events").json()["items"]
    return [item["kind"] for item in reversed(items) if item["kind"].startswith(("control", "command"))]


def test_an_accepted_request_gives_the_requester_the_next_epoch(
    anna: Person, other: Person, robot: Robot, broker: MemoryBroker
) -> None:
    body = {"purpose": "control", "device": robot.device, "epoch": 1}
    issued = anna.post("/mqtt/credentials", body).json()
    with broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"])) as client:
        assert client.connected.is_set()
        answer = request_control(other, robot, within_ms=30_000, lease_ms=45_000)
        assert (answer.status_code, answer.json()["confirmed"]) == (201, True)
        shown = answer.json()["request"]
        request = f"/devices/{robot.device}/lease/requests/{shown['id']}"
        assert answer.headers["location"] == f"/api/v1{request}"
        (command,) = robot.received(RequestControl)
        assert isinstance(command.request, RequestControl)
        assert (command.epoch, command.request.request, command.request.requester) == (1, shown["id"], "anna")
        assert 0 < command.request.answer_within_ms <= 30_000
        assert lease(anna, robot)["request"] == shown | {"mine": False}
        accepted = anna.post(f"{request}/accept").json()
        assert (accepted["epoch"], accepted["confirmed"], accepted["request"]["outcome"]) == (2, True, "accepted")
        assert client.disconnected.is_set(), "the setpoint connection of the former holder is closed"
    again = anna.post(f"{request}/accept").json()
    assert (again["epoch"], again["confirmed"]) == (2, False), "accepting is idempotent"
    grants = robot.received(GrantLease)
    assert [grant.epoch for grant in grants] == [1, 2]
    assert without_pairing(grants[1]) == GrantLease(holder="anna", lease_ms=45_000)
    shown = lease(other, robot)
    assert (shown["epoch"], shown["mine"], shown["request"]) == (2, True, None)
    assert outcome(other, request) == "accepted"
    problem(anna.post(f"{request}/reject"), 409, "control-request-closed")
    problem(other.delete(request), 409, "control-request-closed")
    assert events(anna, robot) == ["control-taken", "control-requested", "control-handed-over"]
    problem(anna.take_lease(robot.device, epoch=1), 409, "lease-lost")
    problem(anna.post("/mqtt/credentials", body), 409, "lease-lost")
    assert other.post("/mqtt/credentials", body | {"epoch": 2}).status_code == 200
    assert events(anna, robot)[3:] == ["command-rejected"] * 2


def test_after_a_rejection_control_may_be_requested_again(anna: Person, other: Person, robot: Robot) -> None:
    request = create(other, robot)
    for _ in "12":
        assert anna.post(f"{request}/reject").json()["outcome"] == "rejected"
        withdrawn = [(each.request, each.epoch, each.caller) for each in robot.received(WithdrawRequest)]
        assert withdrawn == [(WithdrawRequest(request=request.rpartition("/")[2]), 1, "anna")]
    assert lease(other, robot)["request"] is None
    assert lease(anna, robot)["mine"] is True
    assert create(other, robot) != request
    kinds = ["control-taken", "control-requested", "control-request-denied", "control-requested"]
    assert events(anna, robot) == kinds


def test_only_the_requester_withdraws_a_request(anna: Person, other: Person, robot: Robot) -> None:
    request = create(other, robot)
    problem(anna.delete(request), 403, "forbidden")
    for _ in "12":
        assert other.delete(request).status_code == 204
        assert len(robot.received(WithdrawRequest)) == 1, "the device removes the request"
    assert outcome(anna, request) == "withdrawn"
    assert problem(anna.post(f"{request}/accept"), 409, "control-request-closed")["outcome"] == "withdrawn"
    assert lease(anna, robot)["epoch"] == 1
    assert "control-request-withdrawn" in events(anna, robot)


def test_an_unanswered_request_expires(cloud: Cloud, anna: Person, other: Person, robot: Robot) -> None:
    request = create(other, robot, within_ms=5_000)
    cloud.clock.advance(5)
    assert outcome(other, request) == "expired"
    for verb in ("accept", "reject"):
        problem(anna.post(f"{request}/{verb}"), 409, "control-request-closed")
    assert other.delete(request).status_code == 204
    shown = lease(anna, robot)
    assert (shown["epoch"], shown["mine"], shown["request"]) == (1, True, None)
    cloud.clock.advance(11)
    cloud.sweep()
    assert events(anna, robot) == ["control-taken", "control-requested", "control-request-expired"]
    assert create(other, robot) != request
    cloud.clock.advance(100)
    cloud.sweep()
    assert sorted(events(anna, robot)[3:]) == ["control-expired", "control-request-expired", "control-requested"]


def test_one_request_is_open_at_a_time_and_only_the_holder_answers(cloud: Cloud, other: Person, robot: Robot) -> None:
    third, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
    request = create(other, robot)
    again = request_control(other, robot)
    assert (again.status_code, again.json()["request"]["id"]) == (200, request.rpartition("/")[2])
    assert problem(request_control(third, robot), 409, "lease-requested")["requester"] == "anna"
    assert lease(third, robot)["request"]["id"] == request.rpartition("/")[2]
    for verb in ("accept", "reject"):
        for person in (other, third):
            problem(person.post(f"{request}/{verb}"), 403, "forbidden")
        problem(bert.post(f"{request}/{verb}"), 404, "device-unknown")
    assert outcome(other, request) == "open"
    assert other.delete(request).status_code == 204
    assert create(third, robot)


def test_invalid_requests_are_refused(anna: Person, other: Person, robot: Robot) -> None:
    for options in ({"within_ms": 999}, {"within_ms": 120_001}, {"lease_ms": 1}, {"who": "me"}):
        problem(request_control(other, robot, **options), 422, "invalid")
    problem(request_control(anna, robot), 409, "lease-already-held")
    anna.delete(f"/devices/{robot.device}/lease?epoch=1")
    problem(request_control(other, robot), 409, "lease-free")
    unknown = f"/devices/{robot.device}/lease/requests/nothing"
    problem(anna.get(unknown), 404, "request-unknown")
    problem(other.post(f"{unknown}/accept"), 404, "request-unknown")


@pytest.mark.parametrize("how", ["released", "expired", "taken again", "reset"])
def test_a_request_ends_with_its_lease(anna: Person, other: Person, robot: Robot, how: str) -> None:
    anna.take_lease(robot.device, epoch=1, lease_ms=5_000)
    request = create(other, robot)
    ends: dict[str, Any] = {
        "released": lambda: anna.delete(f"/devices/{robot.device}/lease?epoch=1"),
        "expired": lambda: anna.cloud.clock.advance(5),
        "taken again": lambda: anna.take_lease(robot.device),
        "reset": lambda: anna.post(f"/devices/{robot.device}/stop/reset"),
    }
    ends[how]()
    assert outcome(other, request) == "ended"
    problem(anna.post(f"{request}/accept"), 409, "control-request-closed")
    if how == "taken again":
        assert lease(anna, robot)["mine"] is True
    else:
        assert lease(anna, robot) is None
        assert other.take_lease(robot.device).status_code == 200


def test_an_owner_takes_over_with_a_reason(anna: Person, other: Person, robot: Robot) -> None:
    request = create(other, robot)
    problem(other.take_lease(robot.device), 409, "lease-held")
    for invalid in ({}, {"reason": "  "}, {"reason": "now", "epoch": 1}):
        problem(other.take_lease(robot.device, take_over=True, **invalid), 422, "invalid")
    answer = other.take_lease(robot.device, take_over=True, reason="needed in the lab").json()
    assert (answer["epoch"], answer["confirmed"]) == (2, True)
    grant = robot.received(GrantLease)[-1]
    assert without_pairing(grant) == GrantLease(holder="anna", lease_ms=30_000, reason="needed in the lab")
    assert lease(anna, robot)["reason"] == "needed in the lab"
    assert outcome(other, request) == "ended"
    problem(anna.take_lease(robot.device, epoch=1), 409, "lease-lost")
    other.take_lease(robot.device, epoch=2)
    assert robot.received(GrantLease)[-1].request == grant.request, "each renewal contains the reason"
    assert "control-taken-over" in events(anna, robot)
    other.delete(f"/devices/{robot.device}/lease?epoch=2")
    assert anna.take_lease(robot.device, take_over=True, reason="now").json()["epoch"] == 3
    assert lease(anna, robot)["reason"] == "", "a free lease cannot be taken over"


@pytest.mark.parametrize("role", [Role.OPERATOR, Role.VIEWER])
def test_only_an_owner_takes_over_and_a_viewer_has_no_control(
    anna: Person, other: Person, robot: Robot, role: Role, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = create(other, robot)
    original = device_access._device
    monkeypatch.setattr(device_access, "_device", lambda *arguments: replace(original(*arguments), role=role))
    refusal = problem(other.take_lease(robot.device, take_over=True, reason="now"), 403, "forbidden")
    if role is Role.VIEWER:
        problem(other.take_lease(robot.device), 403, "forbidden")
        problem(request_control(other, robot), 403, "forbidden")
        for verb in ("accept", "reject"):
            problem(anna.post(f"{request}/{verb}"), 403, "forbidden")
        problem(anna.delete(f"/devices/{robot.device}/lease?epoch=1"), 403, "forbidden")
        for path in ("stop", "stop/reset"):
            problem(other.post(f"/devices/{robot.device}/{path}"), 403, "forbidden")
        assert other.post("/stop").json() == {"items": []}
    else:
        assert "owner" in refusal["detail"]
        problem(other.take_lease(robot.device), 409, "lease-held")
        assert outcome(other, request) == "open"
    assert lease(anna, robot)["epoch"] == 1
    assert "command-rejected" in events(anna, robot)


def test_a_requester_without_permission_gets_no_control(
    anna: Person, other: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = create(other, robot)
    find = device_access.DeviceAccess.find_with_link

    async def as_viewer(self: device_access.DeviceAccess, caller: Any, device: str) -> Any:
        result, link = await find(self, caller, device)
        if result is not None and caller.session == other.session:
            result = replace(result, role=Role.VIEWER)
        return result, link

    with monkeypatch.context() as patch:
        patch.setattr(device_access.DeviceAccess, "find_with_link", as_viewer)
        refusal = problem(anna.post(f"{request}/accept"), 409, "requester-offline")
        assert "You keep control" in refusal["detail"]
        assert refusal["detail"].startswith("anna ")
    assert other.post("/auth/sign-out").status_code == 204
    problem(anna.post(f"{request}/accept"), 409, "requester-offline")
    assert lease(anna, robot)["epoch"] == 1
    assert anna.post(f"{request}/reject").json()["outcome"] == "rejected"


def test_refusals_are_recorded_once_and_do_not_depend_on_the_record(
    cloud: Cloud, anna: Person, other: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(5):
        problem(other.take_lease(robot.device), 409, "lease-held")
        problem(other.start(robot.device), 409, "lease-held")
    assert events(anna, robot) == ["control-taken", "command-rejected", "command-rejected"]
    cloud.clock.advance(10)
    problem(other.take_lease(robot.device), 409, "lease-held")
    item = anna.get(f"/devices/{robot.device}/events").json()["items"][0]
    assert item["data"] == {"caller": "anna", "wanted": "take control", "code": "lease-held"}
    assert item["severity"] == "warning"
    assert events(anna, robot).count("command-rejected") == 3

    async def full(*_: object) -> None:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(cloud.functions.events, "add", full)
    cloud.clock.advance(10)
    problem(other.take_lease(robot.device), 409, "lease-held")


def test_the_device_may_end_the_lease(cloud: Cloud, anna: Person, other: Person, robot: Robot) -> None:
    now_ms = cloud.clock.now_ms()
    robot.publish_state(State(device="arm", at_ms=now_ms, tick_ms=1, mode=Mode.IDLE, epoch=1, ended_epoch=0))
    assert anna.get(f"/devices/{robot.device}").json()["state"]
    problem(other.take_lease(robot.device), 409, "lease-held")
    robot.publish_state(State(device="arm", at_ms=now_ms, tick_ms=2, mode=Mode.HOLDING, epoch=1, ended_epoch=1))
    assert lease(anna, robot) is None
    assert anna.get(f"/devices/{robot.device}").json()["lease"] is None
    problem(request_control(other, robot), 409, "lease-free")
    action = other.start(robot.device, wait_ms=10_000).json()
    assert (action["status"], action["epoch"]) == ("started", 2)
    assert anna.take_lease(robot.device).status_code == 409
    assert lease(other, robot)["mine"] is True


def test_an_unresponsive_device_confirms_with_the_next_renewal(anna: Person, other: Person, robot: Robot) -> None:
    robot.silent = True
    answer = request_control(other, robot, wait_ms=50)
    assert (answer.status_code, answer.json()["confirmed"]) == (201, False)
    request = f"/devices/{robot.device}/lease/requests/{answer.json()['request']['id']}"
    assert anna.post(f"{request}/accept", {"wait_ms": 0}).json()["confirmed"] is False
    robot.silent = False
    assert other.take_lease(robot.device, epoch=2).json()["confirmed"] is True


def test_release_and_the_lease_of_an_action_are_recorded(cloud: Cloud, anna: Person, robot: Robot) -> None:
    anna.delete(f"/devices/{robot.device}/lease?epoch=1")
    assert robot.received(ReleaseLease)
    assert events(anna, robot) == ["control-taken", "control-released"]
    action = anna.start(robot.device, wait_ms=10_000).json()
    cloud.clock.advance(3)
    cloud.sweep()
    item = anna.get(f"/devices/{robot.device}/events").json()["items"][0]
    data = {"epoch": action["epoch"], "holder": "anna", "action": action["id"]}
    assert (item["kind"], item["data"]) == ("control-taken", data)


def test_without_a_broker(anna: Person, other: Person, robot: Robot, broker: MemoryBroker) -> None:
    broker.reachable = False
    answer = request_control(other, robot)
    assert (answer.status_code, answer.json()["confirmed"]) == (201, False)
    request = f"/devices/{robot.device}/lease/requests/{answer.json()['request']['id']}"
    assert anna.post(f"{request}/reject").json()["outcome"] == "rejected"
    accepted = anna.post(f"{create(other, robot)}/accept").json()
    assert (accepted["epoch"], accepted["confirmed"], accepted["request"]["outcome"]) == (2, False, "accepted")
    assert lease(other, robot)["mine"] is True
    assert other.delete(f"/devices/{robot.device}/lease?epoch=2").status_code == 204
    assert lease(other, robot) is None
