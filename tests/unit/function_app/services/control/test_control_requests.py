"""Control from one hand into another: asked for and given, refused, withdrawn, lapsed; or taken over by an owner."""

from dataclasses import replace
from typing import Any

import pytest

from device_agent.protocol import GrantLease, Mode, ReleaseLease, RequestControl, State, WithdrawRequest
from function_app.domain.identity.accounts import Role
from function_app.ports.broker_access import BrokerAccessError, Credentials
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import StoreError
from function_app.services.devices import device_access as devices_service
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.network.brokers import wait_until

Three = tuple[Person, Person, Robot]
WITHIN_MS = 30_000


@pytest.fixture
def held(cloud: Cloud, pair: tuple[Person, Robot]) -> Three:
    """Anna, who has control with epoch 1; another session; the robot."""
    anna, robot = pair
    assert anna.take(robot.device, lease_ms=60_000).json()["epoch"] == 1
    return anna, cloud.sign_in("anna"), robot


def ask(person: Person, robot: Robot, **options: Any) -> Any:
    return person.post(f"/devices/{robot.device}/lease/requests", options)


def asked(person: Person, robot: Robot, **options: Any) -> str:
    answer = ask(person, robot, **options)
    assert answer.status_code == 201, answer.text
    request: str = answer.json()["request"]["id"]
    return request


def at(robot: Robot, request: str, verb: str = "") -> str:
    return f"/devices/{robot.device}/lease/requests/{request}" + (f"/{verb}" if verb else "")


def lease(person: Person, robot: Robot) -> Any:
    return person.get(f"/devices/{robot.device}/lease").json()["lease"]


def outcome(person: Person, robot: Robot, request: str) -> str:
    found: str = person.get(at(robot, request)).json()["outcome"]
    return found


def told(person: Person, robot: Robot) -> list[str]:
    """Kinds of control events, oldest first."""
    items = person.get(f"/devices/{robot.device}/events").json()["items"]
    return [item["kind"] for item in reversed(items) if item["kind"].startswith(("control", "order"))]


def test_what_is_asked_for_and_accepted_is_the_askers_with_the_next_epoch(held: Three, broker: MemoryBroker) -> None:
    anna, other, robot = held
    body = {"purpose": "control", "device": robot.device, "epoch": 1}
    issued = anna.post("/mqtt/credentials", body).json()
    with broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"])) as client:
        assert client.connected.is_set()
        answer = ask(other, robot, within_ms=WITHIN_MS, lease_ms=45_000)
        assert answer.status_code == 201
        assert answer.json()["confirmed"] is True
        shown = answer.json()["request"]
        assert answer.headers["location"] == "/api/v1" + at(robot, shown["id"])
        (order,) = robot.heard(RequestControl)
        assert order.epoch == 1
        assert isinstance(order.request, RequestControl)
        assert (order.request.request, order.request.requester) == (shown["id"], "anna")
        assert 0 < order.request.answer_within_ms <= WITHIN_MS
        assert lease(anna, robot)["request"] == shown | {"mine": False}
        given = anna.post(at(robot, shown["id"], "accept")).json()
        assert (given["epoch"], given["confirmed"], given["request"]["outcome"]) == (2, True, "accepted")
        wait_until(client.disconnected.is_set, "the cut of the former holder's setpoints")
    grant = robot.heard(GrantLease)[-1]
    assert (grant.epoch, grant.request) == (2, GrantLease(holder="anna", lease_ms=45_000))
    now = lease(other, robot)
    assert (now["epoch"], now["mine"], now["request"]) == (2, True, None)
    assert outcome(other, robot, shown["id"]) == "accepted"
    problem(anna.take(robot.device, epoch=1), 409, "lease-lost")
    problem(anna.post("/mqtt/credentials", body), 409, "lease-lost")
    assert other.post("/mqtt/credentials", body | {"epoch": 2}).status_code == 200
    assert told(anna, robot)[:3] == ["control-taken", "control-requested", "control-handed-over"]
    assert told(anna, robot)[3:] == ["order-refused"] * 2


def test_what_is_refused_stays_where_it_is_and_may_be_asked_for_again(held: Three) -> None:
    anna, other, robot = held
    request = asked(other, robot)
    assert anna.post(at(robot, request, "reject")).json()["outcome"] == "rejected"
    wait_until(lambda: robot.heard(WithdrawRequest), "the end of the request")
    assert robot.heard(WithdrawRequest)[0].request == WithdrawRequest(request=request)
    assert lease(other, robot)["request"] is None
    assert lease(anna, robot)["mine"] is True
    assert asked(other, robot) != request
    assert told(anna, robot) == ["control-taken", "control-requested", "control-request-refused", "control-requested"]


def test_what_is_withdrawn_is_over(held: Three) -> None:
    anna, other, robot = held
    request = asked(other, robot)
    problem(anna.delete(at(robot, request)), 403, "forbidden")
    assert other.delete(at(robot, request)).status_code == 204
    assert other.delete(at(robot, request)).status_code == 204
    wait_until(lambda: robot.heard(WithdrawRequest), "the end of the request")
    assert outcome(anna, robot, request) == "withdrawn"
    over = problem(anna.post(at(robot, request, "accept")), 409, "control-request-closed")
    assert over["outcome"] == "withdrawn"
    assert lease(anna, robot)["epoch"] == 1
    assert "control-request-withdrawn" in told(anna, robot)


def test_an_unanswered_request_does_not_move_control(cloud: Cloud, held: Three) -> None:
    anna, other, robot = held
    request = asked(other, robot, within_ms=5_000)
    cloud.clock.advance(5)
    assert outcome(other, robot, request) == "expired"
    for verb in ("accept", "reject"):
        problem(anna.post(at(robot, request, verb)), 409, "control-request-closed")
    assert other.delete(at(robot, request)).status_code == 204
    now = lease(anna, robot)
    assert (now["epoch"], now["mine"], now["request"]) == (1, True, None)
    cloud.clock.advance(11)
    cloud.sweep()
    assert told(anna, robot) == ["control-taken", "control-requested", "control-request-lapsed"]
    assert asked(other, robot) != request
    cloud.clock.advance(100)
    cloud.sweep()
    kinds = told(anna, robot)
    assert sorted(kinds[3:]) == ["control-expired", "control-request-lapsed", "control-requested"]


def test_only_one_asks_at_a_time_and_asking_again_is_the_same_request(cloud: Cloud, held: Three) -> None:
    _, other, robot = held
    third = cloud.sign_in("anna")
    request = asked(other, robot)
    again = ask(other, robot)
    assert (again.status_code, again.json()["request"]["id"]) == (200, request)
    refused = problem(ask(third, robot), 409, "lease-requested")
    assert refused["requester"] == "anna"
    assert lease(third, robot)["request"]["id"] == request
    assert other.delete(at(robot, request)).status_code == 204
    assert asked(third, robot)


def test_only_who_was_asked_answers(cloud: Cloud, held: Three) -> None:
    _, other, robot = held
    request = asked(other, robot)
    for person in (other, cloud.sign_in("anna")):
        for verb in ("accept", "reject"):
            problem(person.post(at(robot, request, verb)), 403, "forbidden")
    problem(cloud.sign_in("bert").post(at(robot, request, "accept")), 404, "device-unknown")
    assert outcome(other, robot, request) == "open"


def test_an_answer_given_twice_is_given_once(held: Three) -> None:
    anna, other, robot = held
    request = asked(other, robot)
    first = anna.post(at(robot, request, "accept")).json()
    again = anna.post(at(robot, request, "accept")).json()
    assert (first["epoch"], again["epoch"], again["request"]["outcome"]) == (2, 2, "accepted")
    assert [command.epoch for command in robot.heard(GrantLease)] == [1, 2]
    problem(anna.post(at(robot, request, "reject")), 409, "control-request-closed")
    problem(other.delete(at(robot, request)), 409, "control-request-closed")
    assert lease(other, robot)["epoch"] == 2


def test_a_free_lease_and_ones_own_lease_cannot_be_requested(held: Three) -> None:
    anna, other, robot = held
    problem(ask(anna, robot), 409, "lease-already-held")
    anna.delete(f"/devices/{robot.device}/lease?epoch=1")
    problem(ask(other, robot), 409, "lease-free")
    for person in (anna, other):
        problem(person.get(at(robot, "nothing")), 404, "request-unknown")
        problem(person.post(at(robot, "nothing", "accept")), 404, "request-unknown")


@pytest.mark.parametrize("how", ["released", "expired", "taken again", "reset"])
def test_a_request_ends_with_its_lease_and_moves_no_control(cloud: Cloud, held: Three, how: str) -> None:
    anna, other, robot = held
    anna.take(robot.device, epoch=1, lease_ms=5_000)
    request = asked(other, robot)
    ends: dict[str, Any] = {
        "released": lambda: anna.delete(f"/devices/{robot.device}/lease?epoch=1"),
        "expired": lambda: cloud.clock.advance(5),
        "taken again": lambda: anna.take(robot.device),
        "reset": lambda: anna.post(f"/devices/{robot.device}/stop/reset"),
    }
    ends[how]()
    assert outcome(other, robot, request) == "ended"
    problem(anna.post(at(robot, request, "accept")), 409, "control-request-closed")
    if how == "taken again":
        assert lease(anna, robot)["mine"] is True
    else:
        assert lease(anna, robot) is None
        assert other.take(robot.device).status_code == 200


def test_an_owner_takes_control_over_and_says_why(held: Three) -> None:
    anna, other, robot = held
    request = asked(other, robot)
    problem(other.take(robot.device), 409, "lease-held")
    problem(other.take(robot.device, take_over=True), 422, "invalid")
    problem(other.take(robot.device, take_over=True, reason="  "), 422, "invalid")
    problem(other.take(robot.device, take_over=True, reason="now", epoch=1), 422, "invalid")
    taken = other.take(robot.device, take_over=True, reason="needed in the lab").json()
    assert (taken["epoch"], taken["confirmed"]) == (2, True)
    grant = robot.heard(GrantLease)[-1]
    assert grant.request == GrantLease(holder="anna", lease_ms=30_000, reason="needed in the lab")
    assert lease(anna, robot)["reason"] == "needed in the lab"
    assert outcome(other, robot, request) == "ended"
    problem(anna.take(robot.device, epoch=1), 409, "lease-lost")
    other.take(robot.device, epoch=2)
    assert robot.heard(GrantLease)[-1].request == grant.request, "who comes late reads it too"
    assert "control-taken-over" in told(anna, robot)


def test_who_takes_over_what_is_free_simply_takes_it(held: Three) -> None:
    anna, other, robot = held
    anna.delete(f"/devices/{robot.device}/lease?epoch=1")
    assert other.take(robot.device, take_over=True, reason="now").json()["epoch"] == 2
    assert lease(other, robot)["reason"] == ""


@pytest.mark.parametrize("role", [Role.OPERATOR, Role.VIEWER])
def test_who_is_no_owner_takes_nothing_over_and_a_viewer_does_not_even_ask(
    held: Three, role: Role, monkeypatch: pytest.MonkeyPatch
) -> None:
    anna, other, robot = held
    request = asked(other, robot)
    seen = devices_service._device
    monkeypatch.setattr(devices_service, "_device", lambda *all_: replace(seen(*all_), role=role))
    refused = problem(other.take(robot.device, take_over=True, reason="now"), 403, "forbidden")
    if role is Role.VIEWER:
        problem(other.take(robot.device), 403, "forbidden")
        problem(ask(other, robot), 403, "forbidden")
        problem(anna.post(at(robot, request, "accept")), 403, "forbidden")
        for path in (f"/devices/{robot.device}/stop", f"/devices/{robot.device}/stop/reset"):
            problem(other.post(path), 403, "forbidden")
        assert other.post("/stop").json() == {"items": []}
    else:
        assert "owner" in refused["detail"]
        problem(other.take(robot.device), 409, "lease-held")
        assert outcome(other, robot, request) == "open"
    assert lease(anna, robot)["epoch"] == 1
    assert "order-refused" in told(anna, robot)


def test_who_may_no_longer_operate_is_given_nothing(held: Three, monkeypatch: pytest.MonkeyPatch) -> None:
    anna, other, robot = held
    request = asked(other, robot)
    find = devices_service.DeviceAccess.find_with_link

    async def found(self: devices_service.DeviceAccess, who: Any, device: str) -> Any:
        known, link = await find(self, who, device)
        if known is not None and who.session == other.session:
            known = replace(known, role=Role.VIEWER)
        return known, link

    monkeypatch.setattr(devices_service.DeviceAccess, "find_with_link", found)
    assert "You keep control" in problem(anna.post(at(robot, request, "accept")), 409, "requester-offline")["detail"]
    assert lease(anna, robot)["epoch"] == 1


def test_who_has_signed_out_is_given_nothing(held: Three) -> None:
    anna, other, robot = held
    request = asked(other, robot)
    assert other.post("/auth/sign-out").status_code == 204
    problem(anna.post(at(robot, request, "accept")), 409, "requester-offline")
    assert lease(anna, robot)["mine"] is True
    assert anna.post(at(robot, request, "reject")).json()["outcome"] == "rejected"


def test_a_refusal_that_cannot_be_told_is_a_refusal_still(
    cloud: Cloud, held: Three, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, other, robot = held

    async def full(*_: object) -> None:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(cloud.functions.events, "add", full)
    problem(other.take(robot.device), 409, "lease-held")


def test_a_lease_that_the_device_has_ended_is_anybodys(cloud: Cloud, held: Three) -> None:
    anna, other, robot = held
    now_ms = cloud.clock.now_ms()
    state = State(device="arm", at_ms=now_ms, tick_ms=1, mode=Mode.IDLE, epoch=1, ended_epoch=0)
    robot.say_state(state)
    wait_until(lambda: anna.get(f"/devices/{robot.device}").json()["state"], "the state")
    problem(other.take(robot.device), 409, "lease-held")
    robot.say_state(State(device="arm", at_ms=now_ms, tick_ms=2, mode=Mode.HOLDING, epoch=1, ended_epoch=1))
    wait_until(lambda: lease(anna, robot) is None, "the end of the lease")
    assert anna.get(f"/devices/{robot.device}").json()["lease"] is None
    problem(ask(other, robot), 409, "lease-free")
    action = other.start(robot.device, wait_ms=10_000).json()
    assert (action["status"], action["epoch"]) == ("started", 2)
    assert anna.take(robot.device).status_code == 409
    assert lease(other, robot)["mine"] is True


def test_a_device_that_is_away_is_told_by_the_next_renewal(held: Three) -> None:
    anna, other, robot = held
    robot.silent = True
    answer = ask(other, robot, wait_ms=50)
    assert (answer.status_code, answer.json()["confirmed"]) == (201, False)
    request = answer.json()["request"]["id"]
    assert anna.post(at(robot, request, "accept"), {"wait_ms": 0}).json()["confirmed"] is False
    robot.silent = False
    assert other.take(robot.device, epoch=2).json()["confirmed"] is True


@pytest.mark.parametrize("body", [{"within_ms": 999}, {"within_ms": 120_001}, {"lease_ms": 1}, {"who": "me"}], ids=str)
def test_a_request_out_of_bounds_is_refused(held: Three, body: dict[str, object]) -> None:
    _, other, robot = held
    problem(ask(other, robot, **body), 422, "invalid")


def test_every_refusal_is_told_but_not_each_time(cloud: Cloud, held: Three) -> None:
    anna, other, robot = held
    for _ in range(5):
        problem(other.take(robot.device), 409, "lease-held")
        problem(other.start(robot.device), 409, "lease-held")
    assert told(anna, robot) == ["control-taken", "order-refused", "order-refused"]
    cloud.clock.advance(10)
    problem(other.take(robot.device), 409, "lease-held")
    items = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert items[0]["data"] == {"caller": "anna", "wanted": "take control", "code": "lease-held"}
    assert items[0]["severity"] == "warning"
    assert [item["kind"] for item in items].count("order-refused") == 3


def test_release_and_the_lease_of_an_action_are_told(cloud: Cloud, held: Three) -> None:
    anna, _, robot = held
    anna.delete(f"/devices/{robot.device}/lease?epoch=1")
    wait_until(lambda: robot.heard(ReleaseLease), "the release")
    assert told(anna, robot) == ["control-taken", "control-released"]
    action = anna.start(robot.device, wait_ms=10_000).json()
    cloud.clock.advance(3)
    cloud.sweep()
    items = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert (items[0]["kind"], items[0]["data"]) == (
        "control-taken",
        {"epoch": action["epoch"], "holder": "anna", "action": action["id"]},
    )


def test_while_the_broker_is_away_the_tables_decide_and_nothing_is_confirmed(
    cloud: Cloud, held: Three, monkeypatch: pytest.MonkeyPatch
) -> None:
    anna, other, robot = held

    async def away(*_: object, **__: object) -> None:
        raise BusUnavailable("The broker does not answer")

    async def gone(*_: object, **__: object) -> None:
        raise BrokerAccessError("The broker does not answer")

    monkeypatch.setattr(cloud.functions.bus, "publish", away)
    monkeypatch.setattr(cloud.functions.access, "revoke", gone)
    answer = ask(other, robot)
    assert (answer.status_code, answer.json()["confirmed"]) == (201, False)
    assert anna.post(at(robot, answer.json()["request"]["id"], "reject")).json()["outcome"] == "rejected"
    given = anna.post(at(robot, asked(other, robot), "accept")).json()
    assert (given["epoch"], given["confirmed"], given["request"]["outcome"]) == (2, False, "accepted")
    assert lease(other, robot)["mine"] is True
    assert other.delete(f"/devices/{robot.device}/lease?epoch=2").status_code == 204
    assert lease(other, robot) is None
