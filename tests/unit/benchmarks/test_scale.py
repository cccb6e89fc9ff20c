"""Load generators of the scale benchmark use the real protocols, and their results are evaluated correctly."""

import asyncio
import os
from unittest.mock import Mock

import pytest

from benchmarks.scale import brokers, functions, mqtt_packets
from benchmarks.scale.agent import LoopObserver, LoopStatistics
from benchmarks.scale.brokers import Run
from benchmarks.scale.functions import Load
from benchmarks.scale.http_load import HttpLoadResult, RawHttpConnection
from benchmarks.scale.processes import family, processor_s, resident_mb
from benchmarks.scale.publishers import SENT, PublisherResult, telemetry
from benchmarks.scale.robots import AgentProcess, ceilings
from benchmarks.scale.subscriber import MEASURED, SubscriberResult, timestamp_ms
from device_agent.protocol import JointTelemetry, codec


def test_packets_are_returned_when_they_are_complete() -> None:
    packets = [(0x30, b"ab"), (0x31, b"x" * 300)]
    stream = b"".join(mqtt_packets.packet(*packet) for packet in packets)
    buffer, received = bytearray(), list[tuple[int, bytes]]()
    for byte in stream:
        buffer.append(byte)
        received += mqtt_packets.packets(buffer)
    assert received == packets
    assert not buffer


def test_published_messages_are_telemetry_with_their_time() -> None:
    body = telemetry().replace(SENT + b"-1.0", SENT + b"1234.567")
    message = codec.decode(body, JointTelemetry)
    assert (len(message.position_rad), len(message.frames)) == (6, 7)
    assert (timestamp_ms(body, SENT), timestamp_ms(body, MEASURED)) == (1234.567, message.at_ms)


@pytest.mark.parametrize(
    ("received", "p99_ms", "late_ms", "carried"),
    [(10, 49.0, 1.0, True), (9, 1.0, 1.0, False), (10, 51.0, 1.0, False), (10, 1.0, 60.0, False)],
)
def test_a_rate_is_carried_if_nothing_is_lost_or_late(
    received: int, p99_ms: float, late_ms: float, carried: bool
) -> None:
    sent = PublisherResult(sent=10, late_ms=late_ms, duration_s=1.0, processor_s=0.1, message_bytes=900)
    run = Run("amqtt", 20.0, sent, SubscriberResult(received, 0.1, p99_ms, 60.0, 0.1), 0.2)
    assert run.carried is carried
    lost, late = brokers.claims([run])
    assert (lost.measured, late.measured) == (10 - received, p99_ms)
    assert (lost.holds, late.holds) == (received == 10, p99_ms < 50)


def test_a_client_sends_the_next_request_after_a_complete_response_and_counts_rejections() -> None:
    async def run() -> RawHttpConnection:
        connection, transport = RawHttpConnection([b"second", b"first"]), Mock(spec=asyncio.Transport)
        connection.connection_made(transport)
        connection.begin(1e12)
        connection.data_received(b"HTTP/1.1 200 OK\r\nContent-Len")
        connection.data_received(b"gth: 5\r\n\r\nab")
        transport.write.assert_called_once_with(b"second")
        connection.data_received(b"cde")
        transport.write.assert_called_with(b"first")
        connection._deadline_s = 0
        connection.data_received(b"HTTP/1.1 409 Conflict\r\ncontent-length: 4\r\n\r\nbusy")
        assert connection.done.done()
        return connection

    connection = asyncio.run(run())
    assert (len(connection.durations_s), connection.rejected, connection.last_error) == (1, {"409": 1}, "busy")


def load(what: str, per_s: float) -> Load:
    result = HttpLoadResult(
        count=10, per_s=per_s, p50_ms=1.0, p99_ms=2.0, rejected={}, last_error="", response_bytes=1, processor_s=0.1,
        duration_s=1.0,
    )  # fmt: skip
    return Load(1, what, result, 0.5)


def test_reads_are_compared_with_the_bare_application() -> None:
    claims = functions.claims([load(functions.LIST, 300), load(functions.ONE, 500), load(functions.BARE, 1000)])
    assert [(claim.measured, claim.holds) for claim in claims] == [(0.3, False), (0.5, True)]
    assert functions.median_of([load("a", 3), load("a", 1), load("a", 2)]).result.per_s == 2


def test_lateness_is_the_excess_over_the_period() -> None:
    observer = LoopObserver()
    observer.periods_s = {1: 3600.0}
    observer.record(1)
    observer.record(2)
    assert observer.late_ms == []
    observer.record(1)
    observer.record(2)
    assert observer.late_ms[0] == pytest.approx(-3_600_000, abs=10_000)
    assert observer.late_ms[1] >= 0


def agents(agents: int, count: int, late_ms: float) -> AgentProcess:
    return AgentProcess("light", 50.0, agents, count, LoopStatistics(count, 100, 0.1, late_ms, 20.0), 10.0, 140.0)


def test_the_largest_number_of_robots_in_time_is_reported_with_the_memory_of_each() -> None:
    processes = [agents(1, 8, 1.0), agents(1, 16, 7.9), agents(1, 32, 8.1), agents(2, 16, 9.0)]
    assert ceilings(processes) == ["One agent had 16 light robots in time at 50 Hz."]
    assert agents(1, 5, 7.9).in_time
    assert (agents(1, 5, 7.9).row(100.0)[-1], agents(1, 5, 7.9).row(None)[-1]) == (10.0, None)


def test_processor_time_and_memory_of_processes_are_measured() -> None:
    assert os.getpid() in family(os.getppid())
    assert processor_s(os.getpid()) > 0
    assert 1 < resident_mb(os.getpid()) < 10_000
