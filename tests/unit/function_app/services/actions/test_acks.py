"""Acks: what is read from a message, which are accepted, and which latencies they show."""

from collections.abc import Iterator
from typing import Any
from unittest import mock

import pytest

from device_agent.protocol import Ack, AckStatus, Reason, codec, topics
from device_agent.protocol.errors import ProtocolError
from function_app.domain.actions.action import AckReport, Status
from function_app.domain.devices.devices import Device
from function_app.ports.monitoring import Counter, Histogram
from function_app.services.actions.acks import report
from function_app.services.messaging.delivery import SignedCommand
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired
from tests.unit.function_app.services.actions.queue_requests import control_rows, pass_time

Measured = list[tuple[str, str]]


def deep(levels: int) -> dict[str, Any]:
    value: dict[str, Any] = {}
    for _ in range(levels):
        value = {"a": value}
    return value


def test_a_report_has_all_fields_of_the_ack() -> None:
    reason = Reason(code="epoch", message="The epoch is outdated.", epoch=7)
    ack = Ack(
        id="agent00000-arm-00000000000000000000",
        status=AckStatus.FAILED,
        sequence=3,
        at_ms=5,
        tick_ms=6,
        reason=reason,
        progress=0.5,
        output="text",
        result={"a": 1},
    )
    assert report(ack, 9) == AckReport(
        status=Status.FAILED,
        sequence=3,
        at_ms=5,
        received_ms=9,
        reason={"code": "epoch", "message": "The epoch is outdated."},
        device_epoch=7,
        progress=0.5,
        output="text",
        result={"a": 1},
    )


def test_a_result_that_is_nested_too_deeply_is_dropped() -> None:
    ack = Ack(id="x", status=AckStatus.DONE, sequence=1, at_ms=5, tick_ms=6, result=deep(500))
    dropped = report(ack, 9)
    assert (dropped.status, dropped.result, dropped.reason, dropped.device_epoch) == (Status.DONE, {}, None, 0)


def test_an_ack_for_a_command_of_another_device_is_rejected(cloud: Cloud) -> None:
    with paired(cloud, "anna", "left", "right") as (anna, robot):
        left, right = robot.devices
        action = anna.start(left, wait_ms=10_000).json()["id"]
        for command in (action, "x"):
            payload = codec.encode(robot.ack(command, AckStatus.DONE))
            with pytest.raises(ProtocolError):
                cloud.run(
                    cloud.functions.action_acks.ingest(
                        topics.parse(robot.topic(topics.ACK, "right")), payload, by="mqtt"
                    )
                )
        assert anna.action(action)["status"] == "started"
        assert control_rows(cloud, right).get("now:slot") is None


def test_each_ack_is_counted(cloud: Cloud, anna: Person, robot: Robot, running: str) -> None:
    counted: list[tuple[Counter, str]] = []
    with mock.patch.object(cloud.functions.metrics, "count", lambda *measured: counted.append(measured)):
        robot.report(running, AckStatus.DONE)
    assert (Counter.ACKS, "done") in counted
    assert anna.action(running)["status"] == "done"


def test_the_duration_of_an_action_is_observed_once(cloud: Cloud, robot: Robot, running: str) -> None:
    observed: list[tuple[Any, ...]] = []
    with mock.patch.object(cloud.functions.metrics, "observe", lambda *measured: observed.append(measured)):
        robot.report(running, AckStatus.STARTED)
        cloud.clock.advance(3)
        robot.report(running, AckStatus.DONE)
        robot.report(running, AckStatus.DONE)
    ((histogram, duration_s, status),) = [each for each in observed if each[0] is Histogram.ACTIONS]
    assert (histogram, status) == (Histogram.ACTIONS, "done")
    ended = cloud.run(cloud.functions.action_store.get(running))
    assert ended is not None
    assert duration_s * 1000 == pytest.approx(ended.action.ended_ms - ended.action.created_ms, abs=1e-6)
    assert duration_s >= 3


@pytest.fixture
def measured(cloud: Cloud) -> Iterator[Measured]:
    """The measured latencies: status of the action, and the transport."""
    latencies: Measured = []

    async def record(action: Any, transport: str) -> None:
        latencies.append((action.status.value, transport))

    with mock.patch.object(cloud.functions.latencies, "measured", record):
        yield latencies


def test_the_latency_of_an_ended_action_is_measured_once(
    cloud: Cloud, anna: Person, robot: Robot, measured: Measured
) -> None:
    action = anna.start(robot.device, wait_ms=10_000).json()["id"]
    robot.report(action, AckStatus.STARTED, progress=0.5)
    assert measured == []
    robot.report(action, AckStatus.DONE)
    assert measured == [("done", "mqtt")]
    assert cloud.run(cloud.functions.action_store.get(action)) is not None


def test_the_latency_of_an_action_that_ended_before_its_publication_was_stored_is_measured(
    cloud: Cloud, anna: Person, robot: Robot, measured: Measured
) -> None:
    robot.silent = True
    send = cloud.functions.delivery.send

    async def answered(device: Device, command: SignedCommand) -> None:
        await send(device, command)
        ack = robot.ack(command.command, AckStatus.DONE)
        await cloud.functions.action_acks.ingest(topics.parse(robot.topic(topics.ACK)), codec.encode(ack), by="mqtt")

    with mock.patch.object(cloud.functions.delivery, "send", answered):
        assert anna.start(robot.device, wait_ms=1_000, wait_for="done").json()["status"] == "done"
    assert measured == [("done", "mqtt")]


def test_a_report_after_an_unknown_outcome_shows_no_latency(
    cloud: Cloud, anna: Person, robot: Robot, measured: Measured
) -> None:
    robot.silent = True
    action = anna.start(robot.device, ttl_ms=2_000).json()["id"]
    pass_time(cloud, 6)
    robot.report(action, AckStatus.DONE)
    assert anna.action(action)["status"] == "done"
    assert measured == []


@pytest.mark.parametrize("wait_for", ["started", "done"])
def test_a_call_waits_for_its_time_and_not_longer(cloud: Cloud, anna: Person, robot: Robot, wait_for: str) -> None:
    robot.reports = lambda _: (AckStatus.RECEIVED,)
    before_ms = cloud.clock.now_ms()
    answer = anna.start(robot.device, wait_ms=700, wait_for=wait_for)
    assert (answer.status_code, answer.json()["status"]) == (202, "received")
    assert 700 <= cloud.clock.now_ms() - before_ms <= 720


def test_a_waiting_call_reads_what_another_process_has_stored(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.silent = True
    action = anna.start(robot.device).json()["id"]
    call = anna.begin("GET", f"/actions/{action}", params={"wait_ms": 20_000, "wait_for": "started"})
    begun_ms = cloud.clock.now_ms()
    ack = codec.encode(robot.ack(action, AckStatus.STARTED))
    cloud.run(cloud.functions.action_acks.ingest(topics.parse(robot.topic(topics.ACK)), ack, by="mqtt"))
    assert call().json()["status"] == "started"
    assert cloud.clock.now_ms() - begun_ms < 1_000
