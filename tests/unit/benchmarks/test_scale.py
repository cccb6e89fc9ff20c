"""What generates load speaks the protocols as they are, and what is counted is counted right."""

import asyncio
import os

import pytest

from benchmarks.scale import brokers, functions, mqtt_packets
from benchmarks.scale.agent import LoopObserver, LoopStatistics
from benchmarks.scale.brokers import Run
from benchmarks.scale.functions import Load
from benchmarks.scale.http_load import HttpLoadResult, RawHttpConnection, Request
from benchmarks.scale.processes import family, processor_s, resident_mb
from benchmarks.scale.publishers import SENT, PublisherResult, telemetry
from benchmarks.scale.robots import AgentProcess, ceilings
from benchmarks.scale.subscriber import MEASURED, SubscriberResult, said_ms
from device_agent.protocol import JointTelemetry, codec


def test_packets_are_taken_when_they_are_whole_and_no_sooner() -> None:
    long = b"x" * 300
    stream = mqtt_packets.packet(0x30, b"ab") + mqtt_packets.packet(0x31, long)
    assert mqtt_packets.packet(0x30, long)[1:3] == bytes([300 % 128 | 128, 300 // 128])
    buffer, found = bytearray(), list[tuple[int, bytes]]()
    for byte in stream:
        buffer.append(byte)
        found += mqtt_packets.packets(buffer)
    assert found == [(0x30, b"ab"), (0x31, long)]
    assert not buffer


def test_a_message_is_what_a_robot_tells_and_says_when() -> None:
    body = telemetry().replace(SENT + b"-1.0", SENT + b"1234.567")
    told = codec.decode(body, JointTelemetry)
    assert (len(told.position_rad), len(told.frames)) == (6, 7)
    assert said_ms(body, SENT) == 1234.567
    assert said_ms(body, MEASURED) == told.at_ms


@pytest.mark.parametrize(
    ("heard", "p99_ms", "late_ms", "carried"), [(10, 49.0, 1.0, True), (9, 1.0, 1.0, False), (10, 51.0, 1.0, False)]
)
def test_a_rate_is_carried_when_nothing_is_lost_or_late(
    heard: int, p99_ms: float, late_ms: float, *, carried: bool
) -> None:
    run = Run(
        "amqtt",
        20.0,
        PublisherResult(sent=10, late_ms=late_ms, took_s=1.0, processor_s=0.1, message_bytes=900),
        SubscriberResult(heard, 0.1, p99_ms, 60.0, 0.1),
        0.2,
    )
    assert run.carried is carried
    lost, late = brokers.claims([run])
    assert (lost.seen, late.seen) == (10 - heard, p99_ms)
    assert (lost.holds and late.holds) is carried


def test_a_rate_that_the_robots_themselves_did_not_keep_is_not_carried() -> None:
    told = PublisherResult(sent=10, late_ms=60.0, took_s=1.0, processor_s=0.1, message_bytes=900)
    assert not Run("amqtt", 20.0, told, SubscriberResult(10, 0.1, 1.0, 2.0, 0.1), 0.2).carried


class Transport(asyncio.Transport):
    def __init__(self) -> None:
        super().__init__()
        self.written: list[bytes] = []

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.written.append(bytes(data))


def test_a_client_asks_on_when_an_answer_is_whole_and_counts_refusals_apart() -> None:
    async def ask() -> RawHttpConnection:
        line, transport = RawHttpConnection([b"second", b"first"]), Transport()
        line.connection_made(transport)
        line.begin(1e12)
        line.data_received(b"HTTP/1.1 200 OK\r\nContent-Len")
        line.data_received(b"gth: 5\r\n\r\nab")
        assert transport.written == [b"second"]
        line.data_received(b"cde")
        assert transport.written == [b"second", b"first"]
        line._ends_s = 0
        line.data_received(b"HTTP/1.1 409 Conflict\r\ncontent-length: 4\r\n\r\nbusy")
        assert line.done.done()
        return line

    line = asyncio.run(ask())
    assert (len(line.taken), line.refused, line.refusal) == (1, {"409": 1}, "busy")


def test_a_request_is_one_that_a_server_reads() -> None:
    head, _, body = Request("POST", "/a", "secret", '{"ü": 1}').encode().partition(b"\r\n\r\n")
    assert head.startswith(b"POST /a HTTP/1.1\r\n")
    assert b"Authorization: Bearer secret\r\n" in head
    assert f"Content-Length: {len(body)}".encode() in head
    assert Request("GET", "/a").encode().endswith(b"\r\n\r\n")


def load(what: str, per_s: float) -> Load:
    answered = HttpLoadResult(
        count=10,
        per_s=per_s,
        p50_ms=1.0,
        p99_ms=2.0,
        refused={},
        refusal="",
        answer_bytes=1,
        processor_s=0.1,
        took_s=1.0,
    )
    return Load(1, what, answered, 0.5)


def test_reads_are_compared_with_the_bare_application() -> None:
    claims = functions.claims([load(functions.LIST, 300), load(functions.ONE, 500), load(functions.BARE, 1000)])
    assert [(claim.seen, claim.holds) for claim in claims] == [(0.3, False), (0.5, True)]
    assert functions.median_of([load("a", 3), load("a", 1), load("a", 2)]).answered.per_s == 2


def test_lateness_is_what_a_period_took_more_than_it_should() -> None:
    watcher = LoopObserver()
    watcher.periods_s = {1: 3600.0}
    watcher.note(1)
    watcher.note(2)
    assert watcher.late_ms == []
    watcher.note(1)
    watcher.note(2)
    assert watcher.late_ms[0] == pytest.approx(-3_600_000, abs=10_000)
    assert watcher.late_ms[1] >= 0


def test_memory_of_a_robot_is_what_more_of_them_take() -> None:
    crew = AgentProcess("light", 50.0, 1, 5, LoopStatistics(5, 100, 0.1, 7.9, 20.0), 10.0, 140.0)
    assert crew.in_time
    assert crew.row(100.0)[-1] == 10.0
    assert crew.row(None)[-1] is None


def test_the_most_that_were_in_time_are_named() -> None:
    def crew(agents: int, count: int, late_ms: float) -> AgentProcess:
        return AgentProcess("light", 50.0, agents, count, LoopStatistics(count, 100, 0.1, late_ms, 20.0), 10.0, 140.0)

    found = ceilings([crew(1, 8, 1.0), crew(1, 16, 7.9), crew(1, 32, 8.1), crew(2, 16, 9.0)])
    assert found == ["Of one agent's, 16 light ones were in time at 50 Hz."]


def test_a_process_costs_something() -> None:
    assert os.getpid() in family(os.getppid())
    assert processor_s(os.getpid()) > 0
    assert 1 < resident_mb(os.getpid()) < 10_000
