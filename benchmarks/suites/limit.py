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
_ABOUT: Final = """A simulated UR5, its agent, the broker, the functions and who measures are processes of their own.
*Setpoint* runs from the operator's publish to the telemetry which says that the driver has applied it; the arm rests.
*Action* runs from `POST actions` to its answer that the robot has started: identity, role, the row's write, signature,
publish, the agent's checks and journal, ack. The bare ones are answered by another process: over MQTT with QoS 0 a real
setpoint by as many bytes as telemetry has, else 150 bytes of JSON by themselves. An operator's setpoints come 25 ms
apart, and so does everything here: after a pause processors have to wake and caches are cold, and what was 0.3 ms
back to back takes 0.8."""
_TRIED: Final = Table(
    title="Before and after, over mosquitto",
    columns=["what was changed", "setpoint: p50 ms", "×", "action: p50 ms", "×"],
    rows=[
        ["as it was", 17.8, 17.3, 11.4, 4.1],
        ["telemetry goes with setpoints; a period on the thread that brings one", 2.3, 2.3, None, None],
        ["frames all at once and rounded, no look ahead at rest, health every 20 ms", 1.9, 2.0, None, None],
        ["a setpoint's own period uses what the one before saw and prepared; topics are known", 1.4, 1.7, None, None],
        ["only what must last waits for the disk; the office tells that it started", None, None, 9.3, 4.1],
        ["two answers leave together", None, None, 9.9, 3.7],
        ["the worker yields (nice 5)", 1.2, 1.6, 8.3, 3.5],
        ["the disk has the command before motion, not before the answer", None, None, 8.8, 3.2],
        ["tried, not kept: uvloop and httptools (bare HTTP 1.46 → 1.14 ms)", None, None, 7.7, 3.5],
        ["as two rows above, on a quiet machine, as all that follows", 1.36, 1.7, 7.0, 3.3],
        ["what is only stored is read in rounds; who speaks writes; the disk meanwhile", None, 1.6, None, 3.2],
        ["that it was accepted is told at once", 1.16, 1.7, 6.1, 3.1],
    ],
    note="""Each row was measured when it was made, with what is above it, beside other work of the machine: medians,
and the ratios that the claims judge, of one run each (2026-11-22). In parts: a setpoint found telemetry's regular word
in its way, and waited for the control period; then the agent's own 0.7 ms, of which half was arithmetic that nobody had
asked for. An action waited three times for the disk (0.7 to 1.5 ms each). With uvloop and httptools one process answers
1.4 to 2 times as many reads, and a bare FastAPI 1.9 to 2.4 times; nothing else was tried with them, so they are not in
yet. Of the last rows: the worker woke for each message just when somebody waited for another, an agent's messages were
written by a thread that had to be woken, and motion waited for the disk after its start had been told.""",
)
_TOPICS: Final = ("bench/limit/there", "bench/limit/back")


def run(*, quick: bool, say: Callable[[str], None]) -> Report:
    """Measures both brokers; on each, all paths run interleaved."""
    report = Report(
        suite="limit",
        title="Against the limit",
        quick=quick,
        about=[_ABOUT],
    )
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
            text=f"setpoint → applied → seen again, to a bare round trip over {kind}",
            seen=median(taken["setpoint"]) / mqtt,
            bound=SETPOINT_MOST,
            unit="×",
        ),
        Claim(
            text=f"`POST actions` until started, to bare HTTP and a bare round trip over {kind}",
            seen=median(taken["action"]) / (median(taken["MQTT, QoS 1"]) + echo),
            bound=ACTION_MOST,
            unit="×",
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
