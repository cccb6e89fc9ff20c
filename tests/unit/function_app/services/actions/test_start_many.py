"""One call, many devices: each has its own answer, and the trouble of one is not that of the others."""

from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.protocol import AckStatus, MoveJoints
from function_app.entrypoints.http.actions.schemas import MAX_DEVICES
from function_app.services.actions.start_many import CONCURRENT_STARTS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import MOVE, Cloud, Person, paired, problem
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]
NAMES = tuple(f"arm{number}" for number in range(5))


@pytest.fixture
def fleet(cloud: Cloud) -> Iterator[Pair]:
    """Anna, and an agent with five arms."""
    with paired(cloud, "anna", *NAMES) as found:
        yield found


def start(person: Person, *devices: str, **options: Any) -> Any:
    headers = {"Idempotency-Key": options.pop("once")} if "once" in options else {}
    return person.post("/actions", {"devices": devices, "request": MOVE, **options}, headers=headers)


def test_it_starts_on_all_and_answers_in_the_order_asked(fleet: Pair) -> None:
    anna, robot = fleet
    devices = [robot.devices[number] for number in (3, 0, 4, 1, 2)]
    answer = start(anna, *devices, wait_ms=10_000)
    assert answer.status_code == 200
    items = answer.json()["items"]
    assert [item["device"] for item in items] == devices
    assert {item["status"] for item in items} == {200}
    assert {item["action"]["status"] for item in items} == {"started"}
    assert {item["problem"] for item in items} == {None}
    assert sorted(command.device for command in robot.heard(MoveJoints)) == list(NAMES)
    for item in items:
        assert anna.action(item["action"]["id"])["device"] == item["device"]


def test_who_does_not_wait_hears_that_they_are_under_way(fleet: Pair) -> None:
    anna, robot = fleet
    answer = start(anna, *robot.devices)
    assert answer.status_code == 202
    assert {item["status"] for item in answer.json()["items"]} == {202}


def test_what_one_refuses_the_others_do(cloud: Cloud, fleet: Pair) -> None:
    anna, robot = fleet
    busy, free, held, mine, unknown = (*robot.devices[:4], f"{robot.id}-nothing")
    running = anna.start(busy, wait_ms=10_000).json()["id"]
    cloud.sign_in("anna").take(held)
    with paired(cloud, "bert") as (_, other):
        answer = start(anna, busy, free, held, unknown, other.device, mine, wait_ms=10_000)
        assert other.commands == []
    assert answer.status_code == 207
    items = answer.json()["items"]
    assert [item["status"] for item in items] == [409, 200, 409, 404, 404, 200]
    codes = [item["problem"]["type"] if item["problem"] else None for item in items]
    assert codes == [
        "/problems/device-busy",
        None,
        "/problems/lease-held",
        "/problems/device-unknown",
        "/problems/device-unknown",
        None,
    ]
    assert running in items[0]["problem"]["detail"]
    assert [item["action"] is None for item in items] == [True, False, True, True, True, False]


def test_a_robot_that_does_not_answer_holds_up_its_own_answer_only(fleet: Pair) -> None:
    anna, robot = fleet
    silent = robot.devices[2]
    robot.reports = lambda command: () if command.device == NAMES[2] else (AckStatus.RECEIVED, AckStatus.STARTED)
    answer = start(anna, *robot.devices, wait_ms=1_500)
    assert answer.status_code == 202
    assert {item["device"] for item in answer.json()["items"] if item["status"] == 202} == {silent}


def test_the_key_counts_for_each_device_by_itself(fleet: Pair) -> None:
    anna, robot = fleet
    first = start(anna, *robot.devices[:2], once="k", wait_ms=10_000).json()["items"]
    again = start(anna, *robot.devices[:3], once="k", wait_ms=10_000)
    assert again.status_code == 200
    items = again.json()["items"]
    assert [item["action"]["id"] for item in items[:2]] == [item["action"]["id"] for item in first]
    assert len(robot.heard(MoveJoints)) == 3


def test_each_may_run_under_the_lease_that_the_caller_has_on_it(fleet: Pair) -> None:
    anna, robot = fleet
    one, other = robot.devices[:2]
    anna.take(one)
    epochs = {one: anna.take(one).json()["epoch"], other: anna.take(other).json()["epoch"]}
    assert epochs[one] != epochs[other]
    items = start(anna, one, other, epochs=epochs, wait_ms=10_000).json()["items"]
    assert {item["device"]: item["action"]["epoch"] for item in items} == epochs
    items = start(anna, other, epochs={other: 99}).json()["items"]
    assert items[0]["problem"]["type"] == "/problems/lease-lost"


def test_each_may_wait_for_its_turn(fleet: Pair) -> None:
    anna, robot = fleet
    first = start(anna, *robot.devices, wait_ms=10_000).json()["items"]
    second = start(anna, *robot.devices, policy="queue").json()["items"]
    assert {item["action"]["status"] for item in second} == {"queued"}
    for before, after in zip(first, second, strict=True):
        name = before["device"].partition("-")[2]
        robot.say(robot.topic("ack", name), robot.ack(before["action"]["id"], AckStatus.DONE))
        assert anna.action(after["action"]["id"], wait_ms=20_000, wait_for="started")["status"] == "started"


@pytest.mark.parametrize(
    "changes",
    [
        {"devices": []},
        {"devices": ["a"] * 2},
        {"devices": [f"d{number}" for number in range(MAX_DEVICES + 1)]},
        {"devices": ["a/b"]},
        {"devices": "abc"},
        {"epochs": {"b": 1}},
        {"epochs": {"a": 0}},
        {"epoch": 1},
        {"request": {"kind": "fly"}},
    ],
    ids=str,
)
def test_a_call_that_is_wrong_starts_nothing(fleet: Pair, changes: dict[str, Any]) -> None:
    anna, robot = fleet
    problem(anna.post("/actions", {"devices": ["a"], "request": MOVE, **changes}), 422, "invalid")
    assert robot.commands == []


def test_a_hundred_devices_are_started_in_one_call(cloud: Cloud) -> None:
    with (
        paired(cloud, "anna", *(f"a{number}" for number in range(50))) as (anna, one),
        paired(cloud, "anna", *(f"b{number}" for number in range(50))) as (_, two),
    ):
        devices = [*one.devices, *two.devices]
        assert len(devices) == MAX_DEVICES > CONCURRENT_STARTS
        answer = start(anna, *devices, wait_ms=30_000)
        assert answer.status_code == 200, answer.json()["items"][0]
        wait_until(lambda: len(one.heard(MoveJoints)) + len(two.heard(MoveJoints)) == MAX_DEVICES, "the commands")
        assert {item["action"]["status"] for item in answer.json()["items"]} == {"started"}
