"""A request that waits applies acks itself, and loses nothing that other processes store meanwhile."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest

from device_agent.protocol import Ack, AckStatus, MoveJoints, Reason, codec, topics
from function_app.domain.actions.action import Action
from function_app.domain.devices.devices import Device
from function_app.services.messaging.delivery import SignedCommand
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import MOVE, Cloud, Person
from tests.harness.cloud.polling import PollingRobot
from tests.unit.function_app.services.actions.queue_requests import QUEUE, queued
from tests.unit.function_app.services.actions.test_queue_repairs import end_silently


def stored(cloud: Cloud, action: str) -> Action:
    found = cloud.run(cloud.functions.action_store.get(action))
    assert found is not None
    return found.action


def change(cloud: Cloud, action: str, **fields: Any) -> None:
    """Change an action like another process."""
    cloud.run(cloud.functions.action_store.change(action, lambda existing: replace(existing, **fields)))


def begin(person: Person, robot: Robot, **options: Any) -> tuple[str, Callable[[], Any]]:
    """Start an action and wait for its end. Returns its id and a function that waits for the response."""
    body = {"request": MOVE, "wait_ms": 20_000, "wait_for": "done", **options}
    call = person.begin("POST", f"/devices/{robot.device}/actions", json=body)
    return robot.received(MoveJoints)[-1].id, call


@pytest.mark.parametrize("worker", [True, False])
def test_the_times_of_receipt_are_stored(cloud: Cloud, anna: Person, robot: Robot, *, worker: bool) -> None:
    robot.silent = True
    if not worker:
        cloud.stop_ingest()
        action, call = begin(anna, robot)
    else:
        action = anna.start(robot.device).json()["id"]
        call = None
    cloud.clock.advance(3)
    before_ms = cloud.clock.now_ms()
    robot.report(action, AckStatus.STARTED)
    cloud.clock.advance(3)
    between_ms = cloud.clock.now_ms()
    robot.report(action, AckStatus.DONE)
    if call is not None:
        assert call().json()["status"] == "done"
    received = stored(cloud, action).received
    assert before_ms <= received["started"] < between_ms <= received["done"] <= cloud.clock.now_ms()


def test_a_request_stores_what_it_receives_while_the_worker_is_down(cloud: Cloud, anna: Person, robot: Robot) -> None:
    cloud.stop_ingest()
    action, call = begin(anna, robot)
    robot.report(action, AckStatus.DONE, result={"reached": True})
    before_ms = cloud.clock.now_ms()
    assert call().json()["result"] == {"reached": True}
    assert cloud.clock.now_ms() - before_ms < 20, "it does not wait for the next read"
    assert stored(cloud, action).status.value == "done"


def test_a_request_that_stores_acks_keeps_a_cancellation(cloud: Cloud, anna: Person, robot: Robot) -> None:
    cloud.stop_ingest()
    action, call = begin(anna, robot)
    change(cloud, action, cancel_id=f"{robot.device}-00000000000000000001")
    robot.report(action, AckStatus.DONE)
    assert call().json()["status"] == "done"
    assert stored(cloud, action).cancel_id == f"{robot.device}-00000000000000000001"


def test_acks_of_a_rejected_command_do_not_count_for_the_command_issued_again(
    cloud: Cloud, anna: Person, robot: Robot
) -> None:
    cloud.stop_ingest()
    robot.silent = True
    action, call = begin(anna, robot)
    robot.report(action, AckStatus.ACCEPTED)
    rejection = Reason(code="stale_epoch", message="The epoch is outdated.", epoch=5)
    robot.report(action, AckStatus.FAILED, reason=rejection)
    cloud.run(asyncio.sleep(1))
    assert [command.epoch for command in robot.received(MoveJoints)] == [1]
    assert len(robot.payloads[action]) == 2, "issued again"
    robot.report(action, AckStatus.DONE)
    shown = call().json()
    assert (shown["status"], shown["epoch"]) == ("done", 6)
    assert "accepted" not in stored(cloud, action).times


def test_a_waiting_request_notices_at_once_that_its_action_has_left_the_queue(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    robot.silent = True
    waiting = queued(anna, robot.device)
    call = anna.begin("GET", f"/actions/{waiting}", params={"wait_ms": 20_000, "wait_for": "started"})
    cloud.run(asyncio.sleep(1.3))  # it reads the row at 0.75, 1.25 and 1.75 s
    end_silently(cloud, running)
    cloud.run(cloud.functions.queues.check(robot.device))
    cloud.stop_ingest()
    before_ms = cloud.clock.now_ms()
    robot.report(waiting, AckStatus.STARTED)
    assert call().json()["status"] == "started"
    assert cloud.clock.now_ms() - before_ms < 200


@pytest.fixture
def before_subscription(cloud: Cloud) -> Any:
    """Runs something between the first read of an action and the subscription to its acks."""

    @contextlib.contextmanager
    def patched(meanwhile: Callable[[str], Any]) -> Any:
        subscribe = cloud.functions.delivery.acks

        @contextlib.asynccontextmanager
        async def acks(device: Device, command: str) -> AsyncIterator[Any]:
            await meanwhile(command)
            async with subscribe(device, command) as received:
                yield received

        with mock.patch.object(cloud.functions.delivery, "acks", acks):
            yield

    return patched


@pytest.mark.parametrize("again", ["get", "start"])
def test_an_ack_that_was_stored_before_the_subscription_is_seen(
    cloud: Cloud, anna: Person, robot: Robot, before_subscription: Any, again: str
) -> None:
    robot.silent = True
    action = anna.start(robot.device, idempotency_key="k", wait_ms=0, wait_for="started").json()["id"]

    async def report(command: str) -> None:
        payload = codec.encode(robot.ack(command, AckStatus.STARTED))
        await cloud.functions.action_acks.ingest(topics.parse(robot.topic(topics.ACK)), payload, by="mqtt")

    before_ms = cloud.clock.now_ms()
    with before_subscription(report):
        if again == "get":
            status = anna.action(action, wait_ms=20_000, wait_for="started")["status"]
        else:
            status = anna.start(robot.device, idempotency_key="k", wait_ms=0, wait_for="started").json()["status"]
    assert status == "started"
    assert cloud.clock.now_ms() - before_ms < 40, "it does not wait for the next read"


@pytest.mark.parametrize(("wait_ms", "ended"), [(0, False), (20_000, True)])
def test_a_request_that_need_not_wait_does_not_subscribe(
    anna: Person, robot: Robot, running: str, before_subscription: Any, *, wait_ms: int, ended: bool
) -> None:
    if ended:
        robot.report(running, AckStatus.DONE)
    subscribed: list[str] = []

    async def note(command: str) -> None:
        subscribed.append(command)

    with before_subscription(note):
        assert anna.action(running, wait_ms=wait_ms)["status"] == ("done" if ended else "started")
    assert subscribed == []


def answering(cloud: Cloud, robot: Robot, status: AckStatus) -> Any:
    """The ack of a command is stored before its publication."""
    send = cloud.functions.delivery.send

    async def answered(device: Device, command: SignedCommand) -> None:
        await send(device, command)
        ack: Ack = robot.ack(command.command, status)
        topic = topics.parse(robot.topic(topics.ACK))
        await cloud.functions.action_acks.ingest(topic, codec.encode(ack), by=device.transport)

    return mock.patch.object(cloud.functions.delivery, "send", answered)


def test_the_publication_is_stored_after_the_ack_of_a_polling_agent(cloud: Cloud, anna: Person) -> None:
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        robot.open_link()
        with answering(cloud, robot, AckStatus.STARTED):
            answer = anna.start(robot.device, wait_ms=1_000)
        assert (answer.status_code, answer.json()["status"]) == (200, "started")
        assert {"published", "started"} <= set(stored(cloud, answer.json()["id"]).times)


def test_the_publication_by_the_timer_is_stored_after_the_ack(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.silent = True
    first = anna.start(robot.device).json()["id"]
    second = anna.start(robot.device, **QUEUE, wait_ms=0).json()["id"]
    with answering(cloud, robot, AckStatus.STARTED):
        end_silently(cloud, first)
        cloud.run(cloud.functions.queues.check(robot.device))
    assert stored(cloud, second).status.value == "started"
    assert {"published", "started"} <= set(stored(cloud, second).times)
