"""Traces of the agent: the spans of its commands, and a receiver that does not answer."""

import json
import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.cli import run
from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.tracing import NoTraces
from device_agent.protocol import AckStatus, Command, GrantLease, MoveJoints, ResetStop, StopDevice
from device_agent.protocol.security.log_output import JsonFormatter
from device_agent.runtime.storage.journal import Journal
from device_agent.transports import tracing as module
from device_agent.transports.tracing import OtlpTraces
from tests.fakes.tracing import CALLER, TRACE, TRACEPARENT
from tests.harness.agent.device_harness import DeviceHarness
from tests.harness.network.brokers import wait_until
from tests.harness.network.otlp_receiver import OtlpReceiver, last_exports, start_receiver

MOVE = MoveJoints(position_rad={"elbow": 0.2}, speed=1.0)
MALFORMED = (
    *("", "x", f"{TRACEPARENT}-", TRACEPARENT.upper(), f"ff{TRACEPARENT[2:]}", f"01{TRACEPARENT[2:]}"),
    *(f"00-{'0' * 32}-{CALLER}-01", f"00-{TRACE}-{'0' * 16}-01", f"{TRACEPARENT}\n", "00-" + "x" * 5000),
)


@pytest.fixture
def receiver(monkeypatch: pytest.MonkeyPatch) -> Iterator[OtlpReceiver]:
    with start_receiver() as receiver:
        for name, value in receiver.environment().items():
            monkeypatch.setenv(name, value)
        yield receiver


@pytest.fixture
def harness(receiver: OtlpReceiver, tmp_path: Path) -> Iterator[DeviceHarness]:
    del receiver  # its address is in the environment
    traces = OtlpTraces()
    harness = DeviceHarness(tmp_path, traces=traces)
    harness.start()
    yield harness
    harness.stop()
    traces.close()


def stop_command(name: str) -> Command:
    return Command(
        id=name,
        space="s",
        agent="a",
        device="arm",
        issued_at_ms=1,
        ttl_ms=1,
        caller="ann",
        epoch=0,
        request=StopDevice(),
        traceparent=TRACEPARENT,
    )


def test_the_steps_of_an_action_are_spans_and_its_acks_name_them(
    receiver: OtlpReceiver, harness: DeviceHarness
) -> None:
    command = harness.command(MOVE, epoch=1, traceparent=TRACEPARENT)
    harness.end(command)
    whole = receiver.wait_for("command move_joints")
    accept, execute, publish = (receiver.named(name)[0] for name in ("accept", "execute", "publish ack"))
    assert whole.parent == CALLER
    assert {accept.parent, execute.parent, publish.parent} == {whole.id}
    assert accept.end_ns <= execute.start_ns
    assert execute.end_ns <= publish.start_ns
    assert publish.end_ns <= whole.end_ns
    assert whole.attributes == {"telescope.command": command, "telescope.device": "arm"}
    assert whole.service == "telescope-agent"
    assert not whole.failed
    expected = {AckStatus.ACCEPTED: execute, AckStatus.STARTED: execute, AckStatus.DONE: publish}
    for ack in harness.acks(command):
        assert ack.traceparent == f"00-{TRACE}-{expected[ack.status].id}-01"


def test_a_stop_is_traced_until_the_control_loop_has_applied_it(receiver: OtlpReceiver, harness: DeviceHarness) -> None:
    harness.done(StopDevice(), traceparent=TRACEPARENT)
    whole, apply = receiver.wait_for("command stop_device"), receiver.named("apply")[0]
    assert apply.parent == whole.id
    assert receiver.named("publish ack")[0].start_ns >= apply.end_ns


def test_a_rejected_command_is_marked_as_failed(receiver: OtlpReceiver, harness: DeviceHarness) -> None:
    harness.done(GrantLease(holder="ann", lease_ms=60_000), epoch=5)
    harness.failed(ResetStop(), epoch=4, traceparent=TRACEPARENT)
    assert receiver.wait_for("command reset_stop").failed


@pytest.mark.parametrize("traceparent", MALFORMED)
def test_a_malformed_context_is_ignored(receiver: OtlpReceiver, harness: DeviceHarness, traceparent: str) -> None:
    ack = harness.done(StopDevice(), traceparent=traceparent)
    assert not ack.traceparent
    harness.done(StopDevice(), traceparent=TRACEPARENT)
    receiver.wait_for("command stop_device")
    assert {span.trace for span in receiver.spans} == {TRACE}


def test_a_repeated_command_has_one_span(receiver: OtlpReceiver, harness: DeviceHarness) -> None:
    for _ in range(2):
        harness.command(StopDevice(), command_id="same", traceparent=TRACEPARENT)
    harness.done(StopDevice(), command_id="other", traceparent=TRACEPARENT)
    wait_until(lambda: len(receiver.named("command stop_device")) >= 2, "two commands")
    commands = [span.attributes["telescope.command"] for span in receiver.named("command stop_device")]
    assert sorted(commands) == ["other", "same"]
    traces = harness.device.publisher._traces
    assert isinstance(traces, OtlpTraces)
    assert traces._open == {}, "a repetition opens no span"


def test_log_lines_of_a_traced_command_name_the_trace(harness: DeviceHarness, caplog: pytest.LogCaptureFixture) -> None:
    lines: list[dict[str, str]] = []

    class Output(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(json.loads(JsonFormatter().format(record)))

    output = Output()
    logging.getLogger("device_agent").addHandler(output)
    try:
        with caplog.at_level(logging.WARNING, "device_agent"):
            harness.done(GrantLease(holder="ann", lease_ms=60_000), epoch=5)
            traced = harness.command(ResetStop(), epoch=4, traceparent=TRACEPARENT)
            other = harness.command(ResetStop(), epoch=4)
            harness.end(traced)
            harness.end(other)
    finally:
        logging.getLogger("device_agent").removeHandler(output)
    found = {line["action"]: line.get("trace_id") for line in lines if "action" in line}
    assert found == {traced: TRACE, other: None}


def test_a_command_that_a_restart_ended_keeps_its_trace(harness: DeviceHarness, tmp_path: Path) -> None:
    command = harness.running(MoveJoints(position_rad={"elbow": 2.9}, speed=0.01), epoch=1, traceparent=TRACEPARENT)
    harness.journal._execute(f"VACUUM INTO '{tmp_path / 'crashed.db'}'")
    journal = Journal(tmp_path / "crashed.db")
    journal.open(now_ms=wall_ms())
    try:
        journal.end_open(now_ms=wall_ms(), tick_ms=tick_ms())
        (ack,) = (each for each in journal.undelivered("arm").values() if each.id == command)
    finally:
        journal.close()
    assert ack.status is AckStatus.FAILED
    assert str(ack.traceparent).startswith(f"00-{TRACE}-")


def test_spans_without_an_end_are_bounded(receiver: OtlpReceiver, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MAX_OPEN", 1)
    traces = OtlpTraces()
    commands = [stop_command(name) for name in ("first", "second")]
    for command in commands:
        traces.begin(command)
    assert not traces.step("first", AckStatus.DONE)
    assert traces.step("second", AckStatus.DONE)
    for command in commands:
        traces.end(command.id)
    traces.close()
    assert [span.attributes["telescope.command"] for span in receiver.named("command stop_device")] == ["second"]


@pytest.mark.parametrize("reachable", [True, False])
def test_a_receiver_that_does_not_answer_delays_no_command(
    receiver: OtlpReceiver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, reachable: bool
) -> None:
    receiver.answers.clear()
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "1000")
    monkeypatch.setenv("OTEL_BSP_MAX_QUEUE_SIZE", "4")
    monkeypatch.setenv("OTEL_BSP_MAX_EXPORT_BATCH_SIZE", "2")
    if not reachable:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:1")
    traces = OtlpTraces()
    harness = DeviceHarness(tmp_path, traces=traces)
    harness.start()
    try:
        for _ in range(10):
            harness.done(StopDevice(), traceparent=TRACEPARENT)
        if reachable:
            wait_until(lambda: receiver.requests, "an export")
    finally:
        harness.stop()
        earlier = last_exports()
        traces.close()
    assert last_exports() - earlier, "the end did not wait for the exporter, which waits or retries"
    assert not receiver.spans


def test_without_a_receiver_or_the_packages_there_are_no_traces(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert isinstance(run._export_traces({}), NoTraces)
    assert not caplog.text
    monkeypatch.setitem(sys.modules, "device_agent.transports.tracing", None)
    assert isinstance(run._export_traces({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:1"}), NoTraces)
    assert "telescope-agent[tracing]" in caplog.text
