"""A request is accepted while the permission of the requester ends; and refusals name the operation."""

from typing import Any

import pytest

from device_agent.protocol import GrantLease, ReleaseLease, RequestControl
from function_app.services.control.control_events import CHECK_MS
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.accounts.test_api_keys import make
from tests.unit.function_app.services.sharing.shares import share


@pytest.mark.parametrize("requester", ["person", "program"])
def test_the_lease_is_free_if_the_permission_of_the_requester_ends_during_the_handover(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch, *, requester: str
) -> None:
    key, program = make(anna)
    share(anna, f"devices/{robot.device}", bert, "operator")
    places = {
        "person": (records.SHARES, f"device:{robot.device}", f"account:{bert.account}"),
        "program": (records.API_KEYS, key, "key"),
    }
    lease = f"/devices/{robot.device}/lease"
    anna.take_lease(robot.device)
    asking = bert if requester == "person" else program
    request = asking.post(f"{lease}/requests", {}).json()["request"]
    store = cloud.functions.lease_store
    real = store.change

    async def change(*arguments: Any, **options: Any) -> Any:
        result = await real(*arguments, **options)
        await records.remove(cloud.functions.tables, *places[requester])
        return result

    monkeypatch.setattr(store, "change", change)
    refusal = problem(anna.post(f"{lease}/requests/{request['id']}/accept"), 409, "requester-offline")
    assert refusal["detail"].startswith(f"{request['requester']} ")
    assert "free now" in refusal["detail"]
    assert anna.get(lease).json()["lease"] is None
    cloud.run(cloud.functions.control_events.publish(robot.device))
    (event, *_) = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert (event["kind"], event["data"]["reason"]) == ("control-ended", "unshared")
    assert [grant.epoch for grant in robot.received(GrantLease)] == [1], "the requester never had control"
    assert [command.epoch for command in robot.received(ReleaseLease)] == [3], "both epochs are fenced"


@pytest.mark.parametrize(
    ("path", "body", "wanted"),
    [
        ("lease/requests", {}, "ask for control"),
        ("lease/requests/{request}/accept", {}, "hand control over"),
        ("lease/requests/{request}/reject", None, "reject a control request"),
        ("lease/requests/{request}", "delete", "withdraw a request for control"),
        ("lease", {}, "take control"),
        ("lease", {"epoch": 1}, "renew control"),
        ("lease?epoch=1", "delete", "give control back"),
        ("credentials", {"purpose": "control", "epoch": 1}, "steer"),
    ],
)
def test_a_refusal_names_the_operation(
    cloud: Cloud, anna: Person, robot: Robot, *, path: str, body: Any, wanted: str
) -> None:
    requester, third = cloud.sign_in("anna"), cloud.sign_in("anna")
    anna.take_lease(robot.device)
    request = requester.post(f"/devices/{robot.device}/lease/requests", {}).json()["request"]["id"]
    at = f"/devices/{robot.device}/{path.format(request=request)}"
    if path == "credentials":
        answer = third.post("/mqtt/credentials", {**body, "device": robot.device})
    else:
        answer = third.delete(at) if body == "delete" else third.post(at, body)
    assert answer.status_code in {403, 409}
    (event, *_) = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert (event["kind"], event["data"]["wanted"]) == ("command-rejected", wanted)


def test_a_takeover_is_refused_with_its_name(anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    anna.take_lease(robot.device)
    problem(bert.take_lease(robot.device, take_over=True, reason="now"), 403, "forbidden")
    (event, *_) = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert event["data"]["wanted"] == "take control over"


def test_the_device_shows_a_repeated_request_for_the_remaining_time(cloud: Cloud, anna: Person, robot: Robot) -> None:
    requester = cloud.sign_in("anna")
    anna.take_lease(robot.device)
    requests = f"/devices/{robot.device}/lease/requests"
    first = requester.post(requests, {"within_ms": 10_000})
    cloud.clock.ahead_ms += 9_998
    again = requester.post(requests, {})
    assert (first.status_code, again.status_code) == (201, 200)
    shown = [command.request for command in robot.received(RequestControl)]
    remaining = [each.answer_within_ms for each in shown if isinstance(each, RequestControl)]
    assert remaining == [10_000, 1]


def test_a_takeover_closes_the_connection_of_the_former_holder_only(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
) -> None:
    second = cloud.sign_in("anna")
    for person, options in ((anna, {}), (second, {"take_over": True, "reason": "now"})):
        epoch = person.take_lease(robot.device, **options).json()["epoch"]
        assert person.post(
            "/mqtt/credentials", {"purpose": "control", "device": robot.device, "epoch": epoch}
        ).is_success
    control = sorted(grant.client_id for grant in broker.grants.values() if grant.client_id.startswith("c-"))
    assert control == [f"c-{robot.device}-2"]


def test_the_timer_publishes_the_events_of_a_killed_process(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def killed(_: str) -> None:
        """The process ends after the write of the lease."""

    with monkeypatch.context() as patch:
        patch.setattr(cloud.functions.control_events, "publish", killed)
        anna.take_lease(robot.device, lease_ms=600_000)
    events = f"/devices/{robot.device}/events"
    assert anna.get(events).json()["items"] == []
    cloud.clock.advance(CHECK_MS / 1000)
    cloud.sweep()
    assert [item["kind"] for item in anna.get(events).json()["items"]] == ["control-taken"]


def test_commands_name_the_person_who_caused_them(cloud: Cloud, anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    lease = f"/devices/{robot.device}/lease"
    anna.take_lease(robot.device)
    request = bert.post(f"{lease}/requests", {}).json()["request"]["id"]
    anna.post(f"{lease}/requests/{request}/accept")
    cloud.sign_in("anna").take_lease(robot.device, take_over=True, reason="now")
    kinds = (GrantLease, RequestControl)
    commands = [command for command in robot.commands if isinstance(command.request, kinds)]
    assert [(type(command.request), command.caller, command.epoch) for command in commands] == [
        (GrantLease, "anna", 1),
        (RequestControl, "bert", 1),
        (GrantLease, "anna", 2),
        (GrantLease, "anna", 3),
    ]
