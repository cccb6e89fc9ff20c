"""One call starts an action on many devices; each has its own result."""

import asyncio
from collections.abc import Iterator
from typing import Any, cast

import msgspec
import pytest

from device_agent.protocol import AckStatus, MoveJoints
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http.actions.schemas import MAX_DEVICES
from function_app.ports.tables import StoreError
from function_app.services.actions.requests import ActionRequest
from function_app.services.actions.start import StartAction, device_busy
from function_app.services.actions.start_many import CONCURRENT_STARTS, StartOnMany, StartResult
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import MOVE, Cloud, Person, paired, problem
from tests.unit.function_app.services.actions.queue_requests import started

Fleet = tuple[Person, Robot]
NAMES = tuple(f"arm{number}" for number in range(5))


@pytest.fixture
def fleet(cloud: Cloud) -> Iterator[Fleet]:
    """Anna, and an agent with five arms."""
    with paired(cloud, "anna", *NAMES) as pair:
        yield pair


def start(person: Person, *devices: str, **options: Any) -> Any:
    headers = {"Idempotency-Key": options.pop("idempotency_key")} if "idempotency_key" in options else {}
    return person.post("/actions", {"devices": devices, "request": MOVE, **options}, headers=headers)


def test_all_start_and_results_are_in_the_requested_order(fleet: Fleet) -> None:
    anna, robot = fleet
    devices = [robot.devices[number] for number in (3, 0, 4, 1, 2)]
    answer = start(anna, *devices, wait_ms=10_000)
    assert answer.status_code == 200
    items = answer.json()["items"]
    assert [item["device"] for item in items] == devices
    assert {(item["status"], item["action"]["status"], item["problem"]) for item in items} == {(200, "started", None)}
    assert sorted(command.device for command in robot.received(MoveJoints)) == list(NAMES)
    assert [anna.action(item["action"]["id"])["device"] for item in items] == devices
    queued = start(anna, *robot.devices, policy="queue")
    assert (queued.status_code, {item["status"] for item in queued.json()["items"]}) == (202, {202})
    after = {item["device"]: item["action"] for item in queued.json()["items"]}
    assert {action["status"] for action in after.values()} == {"queued"}
    for item in items:
        name = item["device"].partition("-")[2]
        robot.publish(robot.topic("ack", name), robot.ack(item["action"]["id"], AckStatus.DONE))
        assert started(anna, after[item["device"]]["id"])


def test_a_refusal_by_one_does_not_affect_the_others(cloud: Cloud, fleet: Fleet) -> None:
    anna, robot = fleet
    busy, free, leased, mine, unknown = (*robot.devices[:4], f"{robot.id}-nothing")
    running = anna.start(busy, wait_ms=10_000).json()["id"]
    cloud.sign_in("anna").take_lease(leased)
    with paired(cloud, "bert") as (_, other):
        answer = start(anna, busy, free, leased, unknown, other.device, mine, wait_ms=10_000)
        assert other.commands == []
    assert answer.status_code == 207
    items = answer.json()["items"]
    assert [(item["status"], item["problem"] and item["problem"]["type"]) for item in items] == [
        (409, "/problems/device-busy"),
        (200, None),
        (409, "/problems/lease-held"),
        (404, "/problems/device-unknown"),
        (404, "/problems/device-unknown"),
        (200, None),
    ]
    assert running in items[0]["problem"]["detail"]
    assert [item["action"] is None for item in items] == [True, False, True, True, True, False]


def test_an_unresponsive_robot_delays_its_own_result_only(fleet: Fleet) -> None:
    anna, robot = fleet
    robot.reports = lambda command: () if command.device == NAMES[2] else (AckStatus.RECEIVED, AckStatus.STARTED)
    answer = start(anna, *robot.devices, wait_ms=1_500)
    assert answer.status_code == 202
    assert [item["device"] for item in answer.json()["items"] if item["status"] == 202] == [robot.devices[2]]


def test_an_idempotency_key_applies_to_each_device(fleet: Fleet) -> None:
    anna, robot = fleet
    first = start(anna, *robot.devices[:2], idempotency_key="k", wait_ms=10_000).json()["items"]
    again = start(anna, *robot.devices[:3], idempotency_key="k", wait_ms=10_000)
    assert again.status_code == 200
    assert [item["action"]["id"] for item in again.json()["items"][:2]] == [item["action"]["id"] for item in first]
    assert len(robot.received(MoveJoints)) == 3


def test_each_device_may_have_its_own_lease(fleet: Fleet) -> None:
    anna, robot = fleet
    one, other = robot.devices[:2]
    anna.take_lease(one)
    epochs = {one: anna.take_lease(one).json()["epoch"], other: anna.take_lease(other).json()["epoch"]}
    assert epochs[one] != epochs[other]
    items = start(anna, one, other, epochs=epochs, wait_ms=10_000).json()["items"]
    assert {item["device"]: item["action"]["epoch"] for item in items} == epochs
    items = start(anna, other, epochs={other: 99}).json()["items"]
    assert items[0]["problem"]["type"] == "/problems/lease-lost"


def test_an_invalid_call_starts_nothing(cloud: Cloud) -> None:
    anna = cloud.sign_in("anna")
    too_many = [f"d{number}" for number in range(MAX_DEVICES + 1)]
    for devices in ([], ["a"] * 2, too_many, ["a/b"], "abc"):
        problem(anna.post("/actions", {"devices": devices, "request": MOVE}), 422, "invalid")
    for changes in ({"epochs": {"b": 1}}, {"epochs": {"a": 0}}, {"epoch": 1}, {"request": {"kind": "fly"}}):
        problem(anna.post("/actions", {"devices": ["a"], "request": MOVE, **changes}), 422, "invalid")


def test_a_hundred_devices_start_in_one_call(cloud: Cloud) -> None:
    with (
        paired(cloud, "anna", *(f"a{number}" for number in range(50))) as (anna, one),
        paired(cloud, "anna", *(f"b{number}" for number in range(50))) as (_, two),
    ):
        devices = [*one.devices, *two.devices]
        assert len(devices) == MAX_DEVICES > CONCURRENT_STARTS
        answer = start(anna, *devices, wait_ms=30_000)
        assert answer.status_code == 200, answer.json()["items"][0]
        assert len(one.received(MoveJoints)) + len(two.received(MoveJoints)) == MAX_DEVICES
        assert {item["action"]["status"] for item in answer.json()["items"]} == {"started"}


ANNA = Identity("a", "anna", "s")
REQUEST = msgspec.convert({"request": MOVE}, ActionRequest)


class FakeStart:
    """Counts concurrent starts while the gate is held; fails on the devices in ``errors``."""

    def __init__(self, **errors: Exception) -> None:
        self._errors = errors
        self._running = 0
        self.most = 0
        self.calls: list[tuple[Identity, str, ActionRequest, str]] = []

    async def start(
        self, caller: Identity, device: str, request: ActionRequest, *, idempotency_key: str, gate: Any
    ) -> tuple[str, bool]:
        self.calls.append((caller, device, request, idempotency_key))
        async with gate:
            self._running += 1
            self.most = max(self.most, self._running)
            await asyncio.sleep(0)
            self._running -= 1
        if device in self._errors:
            raise self._errors[device]
        return f"action of {device}", True


def start_with(fake: FakeStart, devices: list[str]) -> list[StartResult]:
    service = StartOnMany(start_action=cast("StartAction", fake))
    return asyncio.run(service.start(ANNA, dict.fromkeys(devices, REQUEST), idempotency_key="k"))


def test_a_bounded_number_of_starts_is_written_concurrently() -> None:
    fake = FakeStart()
    devices = [f"d{number}" for number in range(3 * CONCURRENT_STARTS)]
    results = start_with(fake, devices)
    assert fake.most == CONCURRENT_STARTS
    assert results == [StartResult(device, cast("Any", f"action of {device}"), reached=True) for device in devices]
    assert fake.calls == [(ANNA, device, REQUEST, "k") for device in devices]


@pytest.mark.parametrize(
    ("error", "code", "status"),
    [(device_busy("x"), "device-busy", 409), (StoreError("no connection"), "store-unavailable", 503)],
)
def test_a_failed_start_is_the_result_of_its_device_only(error: Exception, code: str, status: int) -> None:
    first, failed = start_with(FakeStart(bad=error), ["good", "bad"])
    assert (first.device, first.reached) == ("good", True)
    assert (failed.device, failed.reached) == ("bad", False)
    assert isinstance(failed.result, Problem)
    assert (failed.result.code, failed.result.status) == (code, status)
    assert failed.result.detail
