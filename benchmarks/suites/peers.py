"""Comparable protocols: time from a setpoint until telemetry reports it as applied."""

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from benchmarks.baseline.interleaved import Exchange, measure_interleaved, median, table
from benchmarks.baseline.product import StreamingOperator, start
from benchmarks.peers import operators, safety
from benchmarks.reporting.report import Chart, Claim, Report, percentile
from tests.harness.network.brokers import BROKERS

TELESCOPE: Final = "Telescope, mosquitto"
ROSBRIDGE: Final = "rosbridge-style, roslibpy"
PEERS: Final = {
    ROSBRIDGE: operators.rosbridge,
    "zenoh, peer to peer": operators.zenoh,
    "gRPC, one stream": operators.grpc,
    "Foxglove, WebSocket": operators.foxglove,
}
_ABOUT: Final = """A setpoint for six joints until telemetry reports it as applied, 40 per second like the console.
Robot, operator and server are separate processes on loopback. The robot is the same simulated UR5 with the same driver.
Telescope is the product as `make up` starts it, with lease, loop age, limits, self-collision check and stored
telemetry. The other programs use their own library, apply each setpoint and report it immediately."""
_HOW: Final = """rosbridge: `roslibpy` at both ends and a server of the rosbridge protocol without ROS, which costs
less than a real one. zenoh: two peers over TCP without a router, `express`. gRPC: a bidirectional stream of bytes
with asyncio at the robot, without protobuf. Foxglove: the SDK's server at the robot, to which the operator publishes.
zenoh, gRPC and Foxglove connect both ends directly: no server can check permissions, and the robot must be reachable.
Telescope and rosbridge use a third process."""


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Measures all protocols interleaved."""
    rounds, each = (6, 25) if quick else (14, 50)
    log("starting all programs")
    with paths() as found:
        log("measuring interleaved")
        samples = measure_interleaved(found, rounds=rounds, each=each)
    report = Report(suite="peers", title="Comparable protocols", quick=quick, about=[_ABOUT, _HOW])
    report.tables += [table("Setpoint until reported as applied", samples, reference=TELESCOPE), safety.table()]
    report.charts.append(_chart(samples))
    report.claims.append(
        Claim(
            "setpoint until reported as applied over mosquitto, to the rosbridge-style peer",
            median(samples[TELESCOPE]) / median(samples[ROSBRIDGE]),
            1.0,
            "×",
        )
    )
    log(report.claims[0].line())
    return report


def _chart(samples: dict[str, list[float]]) -> Chart:
    shares = {"median": 0.5, "p95": 0.95, "p99": 0.99}
    return Chart(
        title="Setpoint until reported as applied",
        kind="bar",
        x_label="",
        y_label="ms",
        x=[name.replace(", ", ",\n") for name in samples],
        series={label: [percentile(each, share) for each in samples.values()] for label, share in shares.items()},
    )


@contextlib.contextmanager
def paths() -> Iterator[dict[str, Exchange]]:
    """Yields the exchanges of two products and four protocols, all connected."""
    with contextlib.ExitStack() as stack:
        exchanges: dict[str, Exchange] = {}
        for kind in reversed(BROKERS):
            home = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            product = stack.enter_context(start(home, kind))
            exchanges[f"Telescope, {kind}"] = stack.enter_context(StreamingOperator(product)).exchange
        for name, open_peer in PEERS.items():
            exchanges[name] = stack.enter_context(open_peer())
        yield exchanges
