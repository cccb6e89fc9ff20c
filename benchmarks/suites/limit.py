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
    start,
    start_peer,
)
from benchmarks.reporting.report import Claim, Report, Table
from tests.harness.network.brokers import BROKERS
from tests.harness.network.ports import free_port

MAX_SETPOINT_RATIO: Final = 1.5
MAX_ACTION_RATIO: Final = 2.5
_ABOUT: Final = """A simulated UR5, its agent, the broker, the functions and the client are separate processes.
*Setpoint* is the time from the operator's publish to the telemetry that reports it as applied; the arm is at rest.
*Action* is the time from `POST actions` to the response `started`: identity, role, row write, signature, publish, the
agent's checks and journal, acknowledgement. An echo process answers the reference exchanges: with MQTT QoS 0 a real
setpoint by as many bytes as telemetry has, otherwise 150 bytes of JSON. All exchanges are 25 ms apart, like an
operator's setpoints. After such a pause processors wake up and caches are cold: 0.3 ms back to back become 0.8 ms."""
_HISTORY: Final = Table(
    title="Effect of changes, with mosquitto",
    columns=["change", "setpoint: p50 ms", "×", "action: p50 ms", "×"],
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
        ["acceptance is acknowledged immediately", 1.16, 1.7, 6.1, 3.1],
    ],
    note="""Each row was measured after its change, including the changes above it, on a machine with other load:
medians and target ratios of one run each (2026-11-22). A setpoint waited for periodic telemetry and for the control
period; the agent itself took 0.7 ms, half of it unnecessary arithmetic. An action waited three times for the disk (0.7
to 1.5 ms each). With uvloop and httptools one process answers 1.4 to 2 times as many reads, and a bare FastAPI 1.9 to
2.4 times as many; they are not used. In the last rows: the worker processed each message immediately and delayed
waiting requests, another thread wrote the agent's messages, and motion waited for the disk after its start
was sent.""",
)
_TOPICS: Final = ("bench/limit/request", "bench/limit/reply")


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Measures both brokers; on each, all paths run interleaved."""
    report = Report(suite="limit", title="Lower bounds", quick=quick, about=[_ABOUT])
    rounds, each = (6, 25) if quick else (20, 50)
    for kind in BROKERS:
        log(f"{kind}: starting")
        with tempfile.TemporaryDirectory() as folder, start(Path(folder), kind) as product, paths(product) as found:
            samples = measure_interleaved(found, rounds=rounds, each=each, pause_s=PERIOD_S)
        _add_results(report, kind, samples)
        for claim in report.claims[-2:]:
            log(claim.line())
    report.tables.append(_HISTORY)
    return report


def _add_results(report: Report, kind: str, samples: dict[str, list[float]]) -> None:
    report.tables.append(table(f"Over {kind}", samples, reference="MQTT, QoS 0"))
    mqtt, echo = median(samples["MQTT, QoS 0"]), median(samples["HTTP"])
    report.claims += [
        Claim(
            f"setpoint until telemetry reports it as applied, to a bare round trip over {kind}",
            median(samples["setpoint"]) / mqtt,
            MAX_SETPOINT_RATIO,
            "×",
        ),
        Claim(
            f"`POST actions` until started, to bare HTTP and a bare round trip over {kind}",
            median(samples["action"]) / (median(samples["MQTT, QoS 1"]) + echo),
            MAX_ACTION_RATIO,
            "×",
        ),
    ]


@contextlib.contextmanager
def paths(product: MeasuredProduct) -> Iterator[dict[str, Exchange]]:
    """Yields all exchanges with open connections."""
    with contextlib.ExitStack() as stack:
        tcp, web = free_port(), free_port()
        stack.enter_context(start_peer("benchmarks.baseline.echo_servers", "tcp", str(tcp)))
        stack.enter_context(start_peer("benchmarks.baseline.echo_servers", "http", str(web)))
        exchanges: dict[str, Exchange] = {"TCP": _tcp(stack, tcp), "HTTP": _http(stack, web)}
        operator = stack.enter_context(StreamingOperator(product))
        operator.exchange()
        exchanges["MQTT, QoS 0"] = mqtt(stack, product, 0, operator.sent, len(operator.received))
        exchanges["MQTT, QoS 1"] = mqtt(stack, product, 1)
        exchanges["setpoint"] = operator.exchange
        caller = stack.enter_context(HttpConnection(product.machine.port, {"Authorization": f"Bearer {product.token}"}))
        exchanges["action"] = partial(operator.run_action, caller)
        yield exchanges


def _tcp(stack: contextlib.ExitStack, port: int) -> Exchange:
    connection = stack.enter_context(socket.create_connection((HOST, port), TIMEOUT_S))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def exchange() -> None:
        connection.sendall(PAYLOAD)
        remaining = len(PAYLOAD)
        while remaining:
            remaining -= len(connection.recv(remaining))

    return exchange


def _http(stack: contextlib.ExitStack, port: int) -> Exchange:
    caller = stack.enter_context(HttpConnection(port))

    def exchange() -> None:
        caller.request("POST", "/echo", PAYLOAD)

    return exchange


def mqtt(
    stack: contextlib.ExitStack, product: MeasuredProduct, qos: int, payload: bytes = PAYLOAD, reply_bytes: int = 0
) -> Exchange:
    """Returns an exchange with another process over MQTT; the reply is the payload, padded if requested."""
    request_topic, reply_topic = (f"{topic}/{qos}" for topic in _TOPICS)
    credentials = product.credentials(publish=(reply_topic,), subscribe=(request_topic,))
    stack.enter_context(
        start_peer(
            "benchmarks.baseline.echo_servers",
            "mqtt",
            str(product.mqtt_port),
            *credentials,
            request_topic,
            reply_topic,
            str(qos),
            str(reply_bytes),
        )
    )
    client = stack.enter_context(product.connect(publish=(request_topic,), subscribe=(reply_topic,), qos=qos))

    def exchange() -> None:
        client.client.publish(request_topic, payload, qos)
        client.received.get(timeout=TIMEOUT_S)

    return exchange
