"""Starting, watching and cancelling actions."""

from typing import Any

import pytest

from device_agent.protocol import (
    AckStatus,
    CancelAction,
    Description,
    MoveJoints,
    RunMovement,
    Say,
    TakePosture,
    topics,
)
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import API, MOVE, Cloud, Person, paired, problem

MINE = "/robot-types/ur5/movements/mine"


def run_mine(**parameters: Any) -> dict[str, Any]:
    return {"kind": "run_movement", "name": "mine", "parameters": parameters}


class TestWaiting:
    def test_a_call_returns_at_the_start_and_another_at_the_end(self, anna: Person, robot: Robot) -> None:
        answer = anna.start(robot.device, wait_ms=10_000)
        action = answer.json()
        assert (answer.status_code, answer.headers["location"]) == (200, f"{API}/actions/{action['id']}")
        assert (action["status"], action["device"], action["caller"]) == ("started", robot.device, "anna")
        assert {"published_ms", "received_ms", "accepted_ms", "started_ms"} <= set(action["times"])
        robot.report(action["id"], AckStatus.STARTED, progress=0.5, output="half\n")
        shown = anna.action(action["id"])
        assert (shown["progress"], shown["output"]) == (0.5, "half\n")
        calls = [anna.begin("GET", f"/actions/{action['id']}", params={"wait_ms": 20_000}) for _ in range(4)]
        anna.action(action["id"], wait_ms=300)
        robot.report(action["id"], AckStatus.DONE, result={"reached": True}, output="there\n")
        for call in calls:
            final = call().json()
            assert (final["status"], final["result"], final["output"]) == ("done", {"reached": True}, "there\n")
            assert "done_ms" in final["times"]
        assert anna.start(robot.device, wait_ms=10_000).status_code == 200

    def test_success_is_reported_only_after_the_start(self, anna: Person, robot: Robot) -> None:
        robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED)
        answer = anna.start(robot.device, wait_ms=700)
        assert (answer.status_code, answer.json()["status"]) == (202, "accepted")
        action = answer.json()["id"]
        assert anna.action(action, wait_ms=200, wait_for="started")["status"] == "accepted"
        call = anna.begin("GET", f"/actions/{action}", params={"wait_ms": 20_000, "wait_for": "started"})
        robot.report(action, AckStatus.STARTED)
        assert call().json()["status"] == "started"
        assert anna.start(robot.device, idempotency_key="k").status_code == 409, "rejected until this action has ended"

    def test_a_call_returns_202_when_its_time_is_over(self, anna: Person, robot: Robot) -> None:
        answer = anna.start(robot.device, wait_ms=500, wait_for="done")
        assert (answer.status_code, answer.json()["status"]) == (202, "started")
        robot.report(answer.json()["id"], AckStatus.DONE)
        answer = anna.start(robot.device)
        assert (answer.status_code, answer.headers["location"]) == (202, f"{API}/actions/{answer.json()['id']}")
        assert anna.action(answer.json()["id"], wait_ms=20_000, wait_for="started")["status"] == "started"
        robot.report(answer.json()["id"], AckStatus.DONE)
        robot.silent = True
        answer = anna.start(robot.device, wait_ms=200)
        assert (answer.status_code, answer.json()["status"]) == (202, "published")
        assert anna.action(answer.json()["id"], wait_ms=200)["status"] == "published"

    def test_an_action_that_ended_before_the_wait_returns_at_once(self, anna: Person, robot: Robot) -> None:
        """The ingest buffers acks: neither the bus nor the tables contain this ack when the call starts."""
        action = anna.start(robot.device, wait_ms=10_000).json()["id"]
        robot.report(action, AckStatus.DONE)
        begun_ms = anna.cloud.clock.now_ms()
        assert anna.action(action, wait_ms=30_000)["status"] == "done"
        assert anna.cloud.clock.now_ms() - begun_ms < 10_000

    def test_immediate_acks_are_never_missed(self, anna: Person, robot: Robot) -> None:
        robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)
        for _ in range(20):
            answer = anna.start(robot.device, wait_ms=10_000, wait_for="done")
            assert (answer.status_code, answer.json()["status"]) == (200, "done")
            assert "published_ms" in answer.json()["times"]

    def test_a_refusal_of_the_robot_ends_the_action_with_its_reason(self, anna: Person, robot: Robot) -> None:
        robot.reports = lambda _: ()
        call = anna.begin("POST", f"/devices/{robot.device}/actions", json={"request": MOVE, "wait_ms": 20_000})
        robot.fail(robot.received(MoveJoints)[0].id, "stopped", "The device is stopped. Reset it first.")
        answer = call()
        assert (answer.status_code, answer.json()["status"]) == (200, "failed")
        assert answer.json()["reason"] == {"code": "stopped", "message": "The device is stopped. Reset it first."}


def test_the_command_carries_request_epoch_and_caller(anna: Person, robot: Robot) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    assert anna.put(MINE, {"source": "robot.home()"}).status_code == 201
    numbers = {"big": 2**70, "small": -0.0, "float": 1e300, "none": None, "yes": True, "list": [1, 2.5]}
    request = run_mine(note="grüß 🤖", **numbers)
    action = anna.start(robot.device, request=request, epoch=epoch, ttl_ms=7_000, wait_ms=10_000).json()
    (command,) = robot.received(RunMovement)
    assert isinstance(command.request, RunMovement)
    shown = anna.get(MINE).json()
    assert (command.id, command.epoch, command.caller, command.ttl_ms) == (action["id"], epoch, "anna", 7_000)
    assert (command.request.source, command.request.sha256) == (shown["source"], shown["sha256"])
    assert command.request.parameters == request["parameters"]
    assert action["request"] == request


def test_a_device_runs_one_action_at_a_time(cloud: Cloud) -> None:
    with paired(cloud, "anna", "left", "right") as (anna, robot):
        left, right = robot.devices
        first = anna.start(left, wait_ms=10_000).json()["id"]
        assert anna.start(right, wait_ms=10_000).status_code == 200
        assert problem(anna.start(left), 409, "device-busy")["action"] == first
        robot.report(first, AckStatus.DONE)
        assert anna.start(left).status_code == 202


def test_an_action_without_a_lease_gets_one_until_it_ends(cloud: Cloud, anna: Person, robot: Robot) -> None:
    other = cloud.sign_in("anna")
    action = anna.start(robot.device, wait_ms=10_000).json()
    refusal = problem(other.take_lease(robot.device), 409, "lease-held")
    assert (refusal["holder"], refusal["mine"]) == ("anna", False)
    problem(other.start(robot.device), 409, "lease-held")
    robot.report(action["id"], AckStatus.DONE)
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert other.take_lease(robot.device).json()["epoch"] == action["epoch"] + 1


@pytest.mark.parametrize("acquired", ["before", "while it runs", "by renewing its own"])
def test_an_explicit_lease_outlives_the_action(anna: Person, robot: Robot, acquired: str) -> None:
    before = anna.take_lease(robot.device).json()["epoch"] if acquired == "before" else None
    action = anna.start(robot.device, epoch=before, wait_ms=10_000).json()
    renewed = None if acquired == "while it runs" else action["epoch"]
    epoch = anna.take_lease(robot.device, epoch=renewed).json()["epoch"]
    assert epoch == action["epoch"] + (acquired == "while it runs")
    robot.report(action["id"], AckStatus.DONE)
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"]["epoch"] == epoch
    assert anna.start(robot.device).json()["epoch"] == epoch


def test_an_epoch_that_is_not_the_callers_starts_nothing(cloud: Cloud, anna: Person, robot: Robot) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    for caller, value in ((anna, epoch + 1), (cloud.sign_in("anna"), epoch)):
        assert problem(caller.start(robot.device, epoch=value), 409, "lease-lost")["current_epoch"] == epoch
    robot.publish_presence(online=False)
    problem(anna.start(robot.device), 409, "device-offline")
    assert robot.received(MoveJoints) == []
    assert anna.get(f"/devices/{robot.device}/actions").json()["items"] == []


@pytest.mark.parametrize(
    ("request_", "status", "code"),
    [
        ({"kind": "run_movement", "name": "nothing"}, 404, "movement-unknown"),
        ({"kind": "run_movement", "name": "../home"}, 422, "invalid"),
        ({"kind": "fly"}, 422, "invalid"),
        ({"kind": "move_joints", "position_rad": {}}, 422, "invalid"),
        ({"kind": "move_joints", "position_rad": {"elbow": "1"}}, 422, "invalid"),
        (MOVE | {"speed": 0}, 422, "invalid"),
        (MOVE | {"speed": 1.01}, 422, "invalid"),
        (MOVE | {"speed": -1}, 422, "invalid"),
        (MOVE | {"sped": 0.5}, 422, "invalid"),
        ({"kind": "run_movement", "name": "wave", "parameters": {"text": "x" * 140_000}}, 422, "parameters-invalid"),
        ({"kind": "run_movement", "name": "wave", "parameters": {"times": 21}}, 422, "parameters-invalid"),
        ({"kind": "run_movement", "name": "wave", "source": "print(1)"}, 422, "invalid"),
        ({"kind": "stop_device"}, 422, "invalid"),
    ],
)
def test_an_invalid_request_occupies_no_slot(
    anna: Person, robot: Robot, request_: dict[str, Any], status: int, code: str
) -> None:
    problem(anna.start(robot.device, request=request_), status, code)
    assert anna.start(robot.device, wait_ms=10_000).status_code == 200


@pytest.mark.parametrize("depth", [20, 100, 200, 300, 500, 900, 5_000, 100_000])
def test_deep_parameters_are_run_or_refused(anna: Person, robot: Robot, depth: int) -> None:
    deep = "[" * depth + "]" * depth
    assert anna.put(MINE, {"source": "robot.home()"}).status_code == 201
    request = f'{{"kind":"run_movement","name":"mine","parameters":{{"deep":{deep}}}}}'
    body = f'{{"wait_ms":10000,"request":{request}}}'
    answer = anna.request("POST", f"/devices/{robot.device}/actions", content=body)
    if answer.status_code == 200:
        assert anna.get(f"/actions/{answer.json()['id']}").json()["request"]["parameters"]["deep"] is not None
        assert answer.json()["status"] == "started"
    else:
        assert answer.json()["type"] in {"/problems/invalid", "/problems/parameters-invalid"}
        assert anna.get(f"/devices/{robot.device}/actions").json()["items"] == []


class TestIdempotencyKey:
    def test_a_repeated_request_returns_the_action_although_the_device_is_offline_now(
        self, anna: Person, robot: Robot
    ) -> None:
        first = anna.start(robot.device, idempotency_key="k1").json()["id"]
        robot.publish_presence(online=False)
        assert anna.start(robot.device, idempotency_key="k1").json()["id"] == first
        problem(anna.start(robot.device, idempotency_key="k2"), 409, "device-offline")

    def test_the_same_request_is_published_once(self, anna: Person, robot: Robot) -> None:
        options = {"json": {"request": MOVE, "wait_ms": 10_000}, "headers": {"Idempotency-Key": "k1"}}
        calls = [anna.begin("POST", f"/devices/{robot.device}/actions", **options) for _ in range(10)]
        first, *others = [call() for call in calls]
        for other in others:
            assert (other.status_code, other.json()["id"]) == (200, first.json()["id"])
        robot.report(first.json()["id"], AckStatus.DONE)
        assert anna.start(robot.device, idempotency_key="k1", wait_ms=10_000).json()["status"] == "done"
        assert len(robot.payloads[first.json()["id"]]) == len(robot.received(MoveJoints)) == 1
        problem(anna.start(robot.device, idempotency_key="k1", ttl_ms=9_000), 422, "idempotency-key-reused")

    def test_each_account_and_device_has_its_own_keys(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        with paired(cloud, "bert", "left", "right") as (bert, other):
            callers = [(anna, robot.device), *((bert, device) for device in other.devices)]
            assert len({caller.start(device, idempotency_key="k1").json()["id"] for caller, device in callers}) == 3

    def test_a_key_has_1_to_200_characters(self, anna: Person, robot: Robot) -> None:
        for key in ("", "x" * 201):
            problem(anna.start(robot.device, idempotency_key=key), 422, "invalid")


def test_a_cancelled_action_ends_when_the_robot_reports_it(anna: Person, robot: Robot) -> None:
    action = anna.start(robot.device, wait_ms=10_000).json()
    answer = anna.post(f"/actions/{action['id']}/cancel")
    assert (answer.status_code, answer.json()["status"]) == (202, "started")
    (cancel,) = robot.received(CancelAction)
    assert (cancel.request, cancel.epoch) == (CancelAction(action=action["id"]), action["epoch"])
    robot.report(action["id"], AckStatus.CANCELLED)
    assert anna.post(f"/actions/{action['id']}/cancel").json()["status"] == "cancelled"
    assert len(robot.received(CancelAction)) == 1


def test_the_list_is_newest_first_and_pages(anna: Person, robot: Robot) -> None:
    robot.reports = lambda _: (AckStatus.DONE,)
    ids = [anna.start(robot.device, wait_ms=10_000, wait_for="done").json()["id"] for _ in range(5)]
    path = f"/devices/{robot.device}/actions"
    assert [item["id"] for item in anna.pages(path, limit=2)] == ids[::-1]
    assert [item["id"] for item in anna.get(path, params={"limit": 2}).json()["items"]] == ids[:2:-1]
    problem(anna.get(path, params={"cursor": "§"}), 422, "cursor-invalid")
    problem(anna.get(path, params={"limit": 0}), 422, "invalid")


def test_the_list_ends_at_the_pairing(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.reports = lambda _: (AckStatus.DONE,)
    ids = [anna.start(robot.device, wait_ms=10_000, wait_for="done").json()["id"] for _ in range(4)]
    tables = cloud.functions.tables
    for action in ids[:3]:
        row = cloud.run(tables.get(records.CONTROL, robot.device, f"action:{action.rpartition('-')[2]}"))
        assert row is not None
        cloud.run(tables.replace(records.CONTROL, row.changed({**row.data, "pairing": "earlier"})))
    listed = anna.get(f"/devices/{robot.device}/actions", params={"limit": 2}).json()
    assert ([item["id"] for item in listed["items"]], listed["cursor"]) == (ids[3:], None)


def test_requests_beyond_the_devices_description_are_refused(anna: Person, robot: Robot) -> None:
    sit = {"kind": "take_posture", "name": "Sit", "speed": 0.5}
    assert anna.start(robot.device, request=sit, wait_ms=10_000).status_code == 200, "postures are not known yet"
    robot.report(robot.received(TakePosture)[0].id, AckStatus.DONE)
    actions, postures = ("move_joints", "take_posture"), ("Stand", "Crouch")
    description = Description(
        device="arm", kind="arm", robot_type="ur5", label="Arm", actions=actions, postures=postures
    )
    robot.publish(robot.topic(topics.DESC), description, retain=True)
    refusal = problem(anna.start(robot.device, request=sit), 422, "unable")
    assert "no posture 'Sit'; it has: Stand, Crouch." in refusal["detail"]
    assert refusal["names"] == ["Stand", "Crouch"]
    rejected = anna.start(robot.device, request={"kind": "say", "text": "hello"})
    assert problem(rejected, 422, "unable")["names"] == ["move_joints", "take_posture"]
    assert robot.received(Say) == []
