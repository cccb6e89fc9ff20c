"""Commands carry the context of their request, and acks lead back to the trace."""

import pytest

from device_agent.protocol import AckStatus, Command, MoveJoints, StopDevice
from tests.fakes.agent import Robot
from tests.fakes.tracing import TRACEPARENT, FakeTracing
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import Cloud, Person
from tests.unit.function_app.services.actions.queue_requests import pass_time


@pytest.fixture
def tracing() -> FakeTracing:
    return FakeTracing()


@pytest.fixture
def cloud(open_cloud: OpenCloud, tracing: FakeTracing) -> Cloud:
    cloud = open_cloud()
    cloud.functions.tracing = tracing  # before the services that use it are created
    cloud.start_ingest()
    return cloud


def sent(robot: Robot, kind: type) -> Command:
    return robot.received(kind)[-1]


def test_commands_of_a_traced_request_carry_its_context(anna: Person, robot: Robot) -> None:
    anna.start(robot.device)
    anna.post(f"/devices/{robot.device}/stop")
    for kind in (MoveJoints, StopDevice):
        assert sent(robot, kind).traceparent == TRACEPARENT


def test_a_command_that_is_published_again_is_identical(
    cloud: Cloud, anna: Person, robot: Robot, tracing: FakeTracing
) -> None:
    robot.reports = lambda _: ()
    action = anna.start(robot.device, ttl_ms=60_000).json()["id"]
    tracing.traceparent = ""  # the timer runs outside the trace
    pass_time(cloud, 5)
    first, second, *_ = robot.payloads[action]
    assert first == second
    assert sent(robot, MoveJoints).traceparent == TRACEPARENT


def test_a_queued_action_keeps_its_context(anna: Person, robot: Robot, tracing: FakeTracing) -> None:
    robot.reports = lambda _: (AckStatus.STARTED,)
    first = anna.start(robot.device).json()["id"]
    second = anna.start(robot.device, policy="queue").json()["id"]
    tracing.traceparent = ""
    robot.report(first, AckStatus.DONE)
    (command,) = (each for each in robot.received(MoveJoints) if each.id == second)
    assert command.traceparent == TRACEPARENT


def test_without_a_trace_the_field_is_absent(anna: Person, robot: Robot, tracing: FakeTracing) -> None:
    tracing.traceparent = ""
    action = anna.start(robot.device).json()["id"]
    assert all(b"traceparent" not in payload for payload in robot.payloads[action])


def test_the_storage_of_a_terminal_ack_joins_the_trace(anna: Person, robot: Robot, tracing: FakeTracing) -> None:
    robot.reports = lambda _: ()
    action = anna.start(robot.device).json()["id"]
    robot.report(action, AckStatus.STARTED, traceparent=TRACEPARENT)
    assert tracing.remotes == [], "a movement that prints reports often"
    robot.report(action, AckStatus.DONE, traceparent=TRACEPARENT)
    assert tracing.remotes == [("store ack", TRACEPARENT)]


@pytest.mark.parametrize("traceparent", ["", "x", TRACEPARENT.upper(), "00-" + "x" * 3000])
def test_an_ack_with_a_malformed_context_is_stored(
    anna: Person, robot: Robot, tracing: FakeTracing, traceparent: str
) -> None:
    robot.reports = lambda _: ()
    action = anna.start(robot.device).json()["id"]
    robot.report(action, AckStatus.DONE, traceparent=traceparent)
    assert anna.action(action)["status"] == "done"
    assert tracing.remotes == []
