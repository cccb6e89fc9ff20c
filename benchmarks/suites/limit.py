"""Telescope compared with its lower bounds: TCP, an MQTT round trip on the same broker, and HTTP."""

import contextlib
import socket
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.baseline.echo_servers import HOST
from benchmarks.baseline.interleaved import Exchange, measure_interleaved, median, table
from benchmarks.baseline.product import (
    PAYLOAD,
    PERIOD_S,
    TIMEOUT_S,
    HttpConnection,
    MeasuredProduct,
    StreamingOperator,
    free_port,
    start,
    start_peer,
)
from benchmarks.reporting.report import Claim, Report, Table
from tests.harness.network.brokers import BROKERS

SETPOINT_MOST: Final = 1.5
ACTION_MOST: Final = 2.5
_ABOUT: Final = """A simulated UR5, its agent, the broker, the functions and the client are separate processes.
*Setpoint* is the time from the operator's publish to the telemetry that reports it as applied; the arm is at rest.
*Action* is the time from `POST actions` to the response `started`: identity, role, row write, signature, publish, the
agent's checks and journal, acknowledgement. An echo process answers the reference exchanges: with MQTT QoS 0 a real
setpoint by as many bytes as telemetry has, otherwise 150 bytes of JSON. All exchanges are 25 ms apart, like an
operator's setpoints. After such a pause processors wake up and caches are cold: 0.3 ms back to back become 0.8 ms."""
_TRIED: Final = Table(
    title="Before and after, with mosquitto",
    columns=["what was changed", "setpoint: p50 ms", "×", "action: p50 ms", "×"],
    rows=[
        ["before", 17.8, 17.3, 11.4, 4.1],
        ["telemetry is published with setpoints; the receiving thread runs the period", 2.3, 2.3, None, None],
        ["frames computed together and rounded, no prediction at rest, health every 20 ms", 1.9, 2.0, None, None],
        ["a setpoint's period reuses results of the previous one; topics are cached", 1.4, 1.7, None, None],
        ["only durable records wait for the disk; the command thread acknowledges the start", None, None, 9.3, 4.1],
        ["two acknowledgements are sent together", None, None, 9.9, 3.7],
        ["the worker yields (nice 5)", 1.2, 1.6, 8.3, 3.5],
        ["the command is on disk before motion, not before the acknowledgement", None, None, 8.8, 3.2],
        ["not adopted: uvloop and httptools (bare HTTP 1.46 → 1.14 ms)", None, None, 7.7, 3.5],
        ["same as two rows above on an idle machine, like all following rows", 1.36, 1.7, 7.0, 3.3],
        [
            "stored messages are read in batches; the publishing thread writes; disk writes overlap",
            None,
            1.6,
            None,
            3.2,
        ],
        ["acceptance is acknowledged at once", 1.16, 1.7, 6.1, 3.1],
    ],
    note="""Each row was measured after its change, including the changes above it, on a machine with other load:
medians and target ratios of one run each (2026-11-22). A setpoint waited for periodic telemetry and for the control
period; the agent itself took 0.7 ms, half of it unnecessary arithmetic. An action waited three times for the disk (0.7
to 1.5 ms each). With uvloop and httptools one process answers 1.4 to 2 times as many reads, and a bare FastAPI 1.9 to
2.4 times as many; they are not used. In the last rows: the worker processed each message at once and delayed waiting
requests, another thread wrote the agent's messages, and motion waited for the disk after its start was sent.""",
)
_TOPICS: Final = ("bench/limit/there", "bench/limit/back")


def run(*, quick: bool, say: Callable[[str], None]) -> Report:
    """Measures both brokers; on each, all paths run interleaved."""
    report = Report(suite="limit", title="Against the limit", quick=quick, about=[_ABOUT])
    rounds, each = (6, 25) if quick else (20, 50)
    for kind in BROKERS:
        say(f"{kind}: starting")
        with tempfile.TemporaryDirectory() as folder, start(Path(folder), kind) as stand, paths(stand) as found:
            taken = measure_interleaved(found, rounds=rounds, each=each, pause_s=PERIOD_S)
        _judge(report, kind, taken)
        for claim in report.claims[-2:]:
            say(claim.line())
    report.tables.append(_TRIED)
    return report


def _judge(report: Report, kind: str, taken: dict[str, list[float]]) -> None:
    report.tables.append(table(f"Over {kind}", taken, against="MQTT, QoS 0"))
    mqtt, echo = median(taken["MQTT, QoS 0"]), median(taken["HTTP"])
    report.claims += [
        Claim(
            f"setpoint → applied → seen again, to a bare round trip over {kind}",
            median(taken["setpoint"]) / mqtt,
            SETPOINT_MOST,
            "×",
        ),
        Claim(
            f"`POST actions` until started, to bare HTTP and a bare round trip over {kind}",
            median(taken["action"]) / (median(taken["MQTT, QoS 1"]) + echo),
            ACTION_MOST,
            "×",
        ),
    ]


@contextlib.contextmanager
def paths(stand: MeasuredProduct) -> Iterator[dict[str, Exchange]]:
    """Yields all exchanges with open connections."""
    with contextlib.ExitStack() as stack:
        tcp, web = free_port(), free_port()
        stack.enter_context(start_peer("benchmarks.baseline.echo_servers", "tcp", str(tcp)))
        stack.enter_context(start_peer("benchmarks.baseline.echo_servers", "http", str(web)))
        found: dict[str, Exchange] = {"TCP": _tcp(stack, tcp), "HTTP": _http(stack, web)}
        hand = stack.enter_context(StreamingOperator(stand))
        hand.exchange()
        found["MQTT, QoS 0"] = mqtt(stack, stand, 0, hand.sent, len(hand.received))
        found["MQTT, QoS 1"] = mqtt(stack, stand, 1)
        found["setpoint"] = hand.exchange
        caller = stack.enter_context(HttpConnection(stand.machine.port, {"Authorization": f"Bearer {stand.token}"}))
        found["action"] = partial(hand.run_action, caller)
        yield found


def _tcp(stack: contextlib.ExitStack, port: int) -> Exchange:
    line = stack.enter_context(socket.create_connection((HOST, port), TIMEOUT_S))
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def exchange() -> None:
        line.sendall(PAYLOAD)
        left = len(PAYLOAD)
        while left:
            left -= len(line.recv(left))

    return exchange


def _http(stack: contextlib.ExitStack, port: int) -> Exchange:
    caller = stack.enter_context(HttpConnection(port))

    def exchange() -> None:
        caller.request("POST", "/echo", PAYLOAD)

    return exchange


def mqtt(
    stack: contextlib.ExitStack, stand: MeasuredProduct, qos: int, payload: bytes = PAYLOAD, answer_bytes: int = 0
) -> Exchange:
    """Returns an exchange with another process over MQTT; the reply is the payload, padded if requested."""
    there, back = (f"{topic}/{qos}" for topic in _TOPICS)
    rights = stand.rights(publish=(back,), subscribe=(there,))
    stack.enter_context(
        start_peer(
            "benchmarks.baseline.echo_servers",
            "mqtt",
            str(stand.mqtt_port),
            *rights,
            there,
            back,
            str(qos),
            str(answer_bytes),
        )
    )
    line = stack.enter_context(stand.connect(publish=(there,), subscribe=(back,), qos=qos))

    def exchange() -> None:
        line.client.publish(there, payload, qos)
        line.received.get(timeout=TIMEOUT_S)

    return exchange
