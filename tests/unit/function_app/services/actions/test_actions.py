"""Starting, watching and cancelling actions, over a real broker and a robot that answers."""

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
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import API, MOVE, Cloud, Person, paired, problem
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]


def test_an_action_waits_until_it_has_started_and_then_until_it_is_done(pair: Pair) -> None:
    anna, robot = pair
    answer = anna.start(robot.device, wait_ms=10_000)
    assert answer.status_code == 200
    action = answer.json()
    assert answer.headers["location"] == f"{API}/actions/{action['id']}"
    assert action["status"] == "started"
    assert action["device"] == robot.device
    assert action["caller"] == "anna"
    assert {"published_ms", "received_ms", "accepted_ms", "started_ms"} <= set(action["times"])
    done = anna.begin("GET", f"/actions/{action['id']}", params={"wait_ms": 20_000})
    robot.report(action["id"], AckStatus.DONE, result={"reached": True}, output="there\n")
    final = done().json()
    assert (final["status"], final["result"], final["output"]) == ("done", {"reached": True}, "there\n")
    assert "done_ms" in final["times"]
    assert anna.start(robot.device, wait_ms=10_000).status_code == 200


def test_success_is_told_only_once_the_robot_has_really_started(pair: Pair) -> None:
    anna, robot = pair
    robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED)
    answer = anna.start(robot.device, wait_ms=700)
    assert (answer.status_code, answer.json()["status"]) == (202, "accepted"), "it has it, it does not move yet"
    action = answer.json()["id"]
    assert anna.action(action, wait_ms=200, wait_for="started")["status"] == "accepted"
    waiting = anna.begin("GET", f"/actions/{action}", params={"wait_ms": 20_000, "wait_for": "started"})
    robot.report(action, AckStatus.STARTED)
    assert waiting().json()["status"] == "started"
    assert anna.start(robot.device, once="k").status_code == 409, "another one is refused until this one has ended"
    robot.report(action, AckStatus.DONE)
    assert anna.action(action, wait_ms=20_000)["status"] == "done"


def test_who_waits_for_the_end_is_told_of_it_and_not_of_the_start(pair: Pair) -> None:
    anna, robot = pair
    answer = anna.start(robot.device, wait_ms=500, wait_for="done")
    assert (answer.status_code, answer.json()["status"]) == (202, "started")
    robot.report(answer.json()["id"], AckStatus.DONE)
    assert anna.action(answer.json()["id"], wait_ms=20_000)["status"] == "done"


def test_a_call_that_does_not_wait_gets_202_and_the_place_to_ask(pair: Pair) -> None:
    anna, robot = pair
    answer = anna.start(robot.device)
    assert answer.status_code == 202
    assert answer.headers["location"] == f"{API}/actions/{answer.json()['id']}"
    assert anna.action(answer.json()["id"], wait_ms=20_000, wait_for="started")["status"] == "started"


def test_the_command_is_what_was_asked_signed_and_with_the_leases_epoch(pair: Pair) -> None:
    anna, robot = pair
    epoch = anna.take(robot.device).json()["epoch"]
    assert anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"}).status_code == 201
    asked = {"kind": "run_movement", "name": "mine", "parameters": {"times": 2, "note": "grüß 🤖"}}
    action = anna.start(robot.device, request=asked, epoch=epoch, ttl_ms=7_000, wait_ms=10_000).json()
    (command,) = robot.heard(RunMovement)
    assert isinstance(command.request, RunMovement)
    shown = anna.get("/robot-types/ur5/movements/mine").json()
    assert (command.id, command.epoch, command.caller, command.ttl_ms) == (action["id"], epoch, "anna", 7_000)
    assert (command.request.source, command.request.sha256) == (shown["source"], shown["sha256"])
    assert command.request.parameters == {"times": 2, "note": "grüß 🤖"}
    assert action["request"] == asked


def test_a_robot_that_is_fast_is_heard_however_soon_it_answers(pair: Pair) -> None:
    anna, robot = pair
    robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)
    for _ in range(20):
        answer = anna.start(robot.device, wait_ms=10_000, wait_for="done")
        assert (answer.status_code, answer.json()["status"]) == (200, "done")
        assert "published_ms" in answer.json()["times"]


def test_a_refusal_of_the_robot_is_the_actions_end_and_says_why(pair: Pair) -> None:
    anna, robot = pair
    robot.reports = lambda _: ()
    answer = anna.begin("POST", f"/devices/{robot.device}/actions", json={"request": MOVE, "wait_ms": 20_000})
    wait_until(lambda: robot.heard(MoveJoints), "the command")
    robot.fail(robot.heard(MoveJoints)[0].id, "stopped", "The device is stopped. Reset it first.")
    assert answer().status_code == 200
    assert answer().json()["status"] == "failed"
    assert answer().json()["reason"] == {"code": "stopped", "message": "The device is stopped. Reset it first."}


def test_a_device_runs_one_action_at_a_time_and_says_which(pair: Pair) -> None:
    anna, robot = pair
    first = anna.start(robot.device, wait_ms=10_000).json()
    refusal = problem(anna.start(robot.device), 409, "device-busy")
    assert refusal["action"] == first["id"]
    robot.report(first["id"], AckStatus.DONE)
    wait_until(lambda: anna.action(first["id"])["status"] == "done", "the end")
    assert anna.start(robot.device).status_code == 202


def test_two_devices_of_one_agent_are_busy_apart(cloud: Cloud) -> None:
    with paired(cloud, "anna", "left", "right") as (anna, robot):
        for device in robot.devices:
            assert anna.start(device, wait_ms=10_000).status_code == 200


def test_an_action_without_a_lease_brings_one_for_its_own_time(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    other = cloud.sign_in("anna")
    action = anna.start(robot.device, wait_ms=10_000).json()
    held = problem(other.take(robot.device), 409, "lease-held")
    assert (held["holder"], held["mine"]) == ("anna", False)
    problem(other.start(robot.device), 409, "lease-held")
    robot.report(action["id"], AckStatus.DONE)
    wait_until(lambda: anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None, "the lease to end")
    assert other.take(robot.device).json()["epoch"] == action["epoch"] + 1


def test_a_lease_that_was_taken_on_purpose_outlives_the_action(pair: Pair) -> None:
    anna, robot = pair
    epoch = anna.take(robot.device).json()["epoch"]
    action = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()
    assert action["epoch"] == epoch
    robot.report(action["id"], AckStatus.DONE)
    wait_until(lambda: anna.action(action["id"])["status"] == "done", "the end")
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"]["epoch"] == epoch
    assert anna.start(robot.device).json()["epoch"] == epoch


def test_an_epoch_that_is_not_the_callers_starts_nothing(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    epoch = anna.take(robot.device).json()["epoch"]
    for caller, given in ((anna, epoch + 1), (cloud.sign_in("anna"), epoch)):
        lost = problem(caller.start(robot.device, epoch=given), 409, "lease-lost")
        assert lost["current_epoch"] == epoch
    assert robot.heard(MoveJoints) == []
    assert anna.get(f"/devices/{robot.device}/actions").json()["items"] == []


def test_a_device_that_said_it_is_offline_gets_no_action(pair: Pair) -> None:
    anna, robot = pair
    robot.say_presence(online=False)
    wait_until(lambda: not anna.get(f"/devices/{robot.device}").json()["online"], "offline")
    problem(anna.start(robot.device), 409, "device-offline")


@pytest.mark.parametrize(
    ("request_", "status", "code"),
    [
        ({"kind": "run_movement", "name": "nothing"}, 404, "movement-unknown"),
        ({"kind": "run_movement", "name": "../home"}, 422, "invalid"),
        ({"kind": "fly"}, 422, "invalid"),
        ({"kind": "move_joints", "position_rad": {}}, 422, "invalid"),
        ({"kind": "move_joints", "position_rad": {"elbow": "1"}}, 422, "invalid"),
        ({"kind": "move_joints", "position_rad": {"elbow": 1.0}, "speed": 0}, 422, "invalid"),
        ({"kind": "move_joints", "position_rad": {"elbow": 1.0}, "speed": 1.01}, 422, "invalid"),
        ({"kind": "move_joints", "position_rad": {"elbow": 1.0}, "speed": -1}, 422, "invalid"),
        ({"kind": "run_movement", "name": "wave", "parameters": {"text": "x" * 140_000}}, 422, "parameters-invalid"),
        ({"kind": "run_movement", "name": "wave", "parameters": {"times": 21}}, 422, "parameters-invalid"),
        ({"kind": "run_movement", "name": "wave", "source": "print(1)"}, 422, "invalid"),
        ({"kind": "stop_device"}, 422, "invalid"),
    ],
)
def test_what_cannot_be_run_is_refused_and_takes_no_slot(
    pair: Pair, request_: dict[str, Any], status: int, code: str
) -> None:
    anna, robot = pair
    problem(anna.start(robot.device, request=request_), status, code)
    assert anna.start(robot.device, wait_ms=10_000).status_code == 200


@pytest.mark.parametrize("depth", [20, 100, 200, 300, 500, 900, 5_000, 100_000])
def test_parameters_however_deep_are_run_or_refused(pair: Pair, depth: int) -> None:
    anna, robot = pair
    deep = "[" * depth + "]" * depth
    assert anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"}).status_code == 201
    asked = f'{{"kind":"run_movement","name":"mine","parameters":{{"deep":{deep}}}}}'
    body = f'{{"wait_ms":10000,"request":{asked}}}'
    answer = anna.ask("POST", f"/devices/{robot.device}/actions", content=body)
    if answer.status_code == 200:
        assert anna.get(f"/actions/{answer.json()['id']}").json()["request"]["parameters"]["deep"] is not None
        assert answer.json()["status"] == "started"
    else:
        assert answer.json()["type"] in {"/problems/invalid", "/problems/parameters-invalid"}
        assert anna.get(f"/devices/{robot.device}/actions").json()["items"] == []


def test_numbers_in_parameters_arrive_as_they_were_sent(pair: Pair) -> None:
    anna, robot = pair
    parameters = {"big": 2**70, "small": -0.0, "float": 1e300, "none": None, "yes": True, "list": [1, 2.5]}
    assert anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"}).status_code == 201
    asked = {"kind": "run_movement", "name": "mine", "parameters": parameters}
    assert anna.start(robot.device, request=asked, wait_ms=10_000).json()["request"]["parameters"] == parameters
    (command,) = robot.heard(RunMovement)
    assert isinstance(command.request, RunMovement)
    assert command.request.parameters == parameters


class TestIdempotencyKey:
    def test_the_same_request_is_the_same_action_and_is_published_once(self, pair: Pair) -> None:
        anna, robot = pair
        first = anna.start(robot.device, once="k1", wait_ms=10_000).json()
        again = anna.start(robot.device, once="k1", wait_ms=10_000)
        assert (again.status_code, again.json()["id"]) == (200, first["id"])
        robot.report(first["id"], AckStatus.DONE)
        wait_until(lambda: anna.action(first["id"])["status"] == "done", "the end")
        assert anna.start(robot.device, once="k1", wait_ms=10_000).json()["status"] == "done"
        assert len(robot.payloads[first["id"]]) == 1
        assert len(robot.heard(MoveJoints)) == 1

    def test_another_request_under_the_same_key_is_refused(self, pair: Pair) -> None:
        anna, robot = pair
        anna.start(robot.device, once="k1")
        problem(anna.start(robot.device, once="k1", ttl_ms=9_000), 422, "idempotency-key-reused")

    def test_two_accounts_and_two_devices_have_keys_of_their_own(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        with paired(cloud, "bert", "left", "right") as (bert, other):
            ids = {
                person.start(device, once="k1").json()["id"]
                for person, device in ((anna, robot.device), *((bert, device) for device in other.devices))
            }
        assert len(ids) == 3

    def test_ten_at_once_are_one_action(self, pair: Pair) -> None:
        anna, robot = pair
        body = {"request": MOVE, "wait_ms": 10_000}
        path, headers = f"/devices/{robot.device}/actions", {"Idempotency-Key": "k1"}
        answers = [anna.begin("POST", path, json=body, headers=headers) for _ in range(10)]
        found = [answer() for answer in answers]
        assert {answer.status_code for answer in found} == {200}
        assert len({answer.json()["id"] for answer in found}) == 1
        assert len(robot.heard(MoveJoints)) == 1

    @pytest.mark.parametrize("key", ["", "x" * 201])
    def test_a_key_has_1_to_200_characters(self, pair: Pair, key: str) -> None:
        anna, robot = pair
        problem(anna.start(robot.device, once=key), 422, "invalid")


def test_everybody_who_waits_for_one_action_hears_of_its_end(pair: Pair) -> None:
    anna, robot = pair
    action = anna.start(robot.device, wait_ms=10_000).json()["id"]
    waiting = [anna.begin("GET", f"/actions/{action}", params={"wait_ms": 15_000}) for _ in range(4)]
    anna.action(action, wait_ms=300)
    robot.report(action, AckStatus.DONE)
    assert [answer().json()["status"] for answer in waiting] == ["done"] * 4


def test_waiting_for_what_does_not_come_ends_with_the_time(pair: Pair) -> None:
    anna, robot = pair
    robot.silent = True
    answer = anna.start(robot.device, wait_ms=200)
    assert (answer.status_code, answer.json()["status"]) == (202, "published")
    assert anna.action(answer.json()["id"], wait_ms=200)["status"] == "published"


def test_a_cancelled_action_ends_when_the_robot_says_so(pair: Pair) -> None:
    anna, robot = pair
    action = anna.start(robot.device, wait_ms=10_000).json()
    answer = anna.post(f"/actions/{action['id']}/cancel")
    assert (answer.status_code, answer.json()["status"]) == (202, "started")
    wait_until(lambda: robot.heard(CancelAction), "the cancel command")
    assert robot.heard(CancelAction)[0].request == CancelAction(action=action["id"])
    assert robot.heard(CancelAction)[0].epoch == action["epoch"]
    robot.report(action["id"], AckStatus.CANCELLED)
    assert anna.action(action["id"], wait_ms=20_000)["status"] == "cancelled"
    assert anna.post(f"/actions/{action['id']}/cancel").json()["status"] == "cancelled"
    assert len(robot.heard(CancelAction)) == 1


def test_the_list_is_newest_first_and_pages(pair: Pair) -> None:
    anna, robot = pair
    robot.reports = lambda _: (AckStatus.DONE,)
    ids = [anna.start(robot.device, wait_ms=10_000, wait_for="done").json()["id"] for _ in range(5)]
    path = f"/devices/{robot.device}/actions"
    listed: list[str] = []
    cursor: str | None = None
    while True:
        page = anna.get(path, params={"limit": 2} | ({"cursor": cursor} if cursor else {})).json()
        listed += [item["id"] for item in page["items"]]
        cursor = page["cursor"]
        if cursor is None:
            break
    assert listed == ids[::-1]
    problem(anna.get(path, params={"cursor": "§"}), 422, "cursor-invalid")
    problem(anna.get(path, params={"limit": 0}), 422, "invalid")


def test_progress_and_output_are_shown_while_it_runs(pair: Pair) -> None:
    anna, robot = pair
    action = anna.start(robot.device, wait_ms=10_000).json()["id"]
    robot.report(action, AckStatus.STARTED, progress=0.5, output="half\n")
    wait_until(lambda: anna.action(action)["progress"] == 0.5, "progress")
    assert anna.action(action)["output"] == "half\n"


def test_what_the_device_says_it_cannot_is_refused_at_once_with_what_it_can(pair: Pair) -> None:
    anna, robot = pair
    asked = {"kind": "take_posture", "name": "Sit", "speed": 0.5}
    assert anna.start(robot.device, request=asked, wait_ms=10_000).status_code == 200, "its postures are not known yet"
    robot.report(robot.heard(TakePosture)[0].id, AckStatus.DONE)
    description = Description(
        device="arm",
        kind="arm",
        robot_type="ur5",
        label="Arm",
        actions=("move_joints", "take_posture"),
        postures=("Stand", "Crouch"),
    )
    robot.say(robot.topic(topics.DESC), description, retain=True)
    wait_until(lambda: anna.start(robot.device, request=asked).status_code == 422, "the description")
    refusal = problem(anna.start(robot.device, request=asked), 422, "unable")
    assert "no posture 'Sit'; it has: Stand, Crouch." in refusal["detail"]
    assert refusal["names"] == ["Stand", "Crouch"]
    spoken = anna.start(robot.device, request={"kind": "say", "text": "hello"})
    assert problem(spoken, 422, "unable")["names"] == ["move_joints", "take_posture"]
    assert robot.heard(Say) == []
