"""Many robots publish through one broker to one subscriber: losses, latency and processor time."""

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import msgspec

from benchmarks.reporting.report import Cell, Claim, Table
from benchmarks.scale.processes import processor_s
from benchmarks.scale.publishers import PublisherOptions, PublisherResult, Robot
from benchmarks.scale.subscriber import SubscriberOptions, SubscriberResult
from tests.harness.network.brokers import BrokerKind, RunningBroker, start_broker
from tests.harness.paths import ROOT

ROBOTS: Final = 50
MAX_LATENCY_MS: Final = 50.0
RATES_HZ: Final[dict[BrokerKind, float]] = {"mosquitto": 50.0, "amqtt": 20.0}
"""Target rate of each broker."""
HIGHER_RATES_HZ: Final[dict[BrokerKind, tuple[float, ...]]] = {
    "mosquitto": (100.0, 400.0, 800.0, 1200.0),
    "amqtt": (50.0, 100.0, 200.0, 300.0, 400.0),
}
COLUMNS: Final = [
    "broker", "robots × Hz", "messages/s", "lost", "p50 ms", "p99 ms", "max ms",
    "broker, µs of a core per message", "broker, % of a core", "publishers, %", "subscriber, %", "sent late, p99 ms",
]  # fmt: skip


class Run(msgspec.Struct):
    """Result of one rate."""

    kind: BrokerKind
    rate_hz: float
    published: PublisherResult
    received: SubscriberResult
    broker_s: float

    @property
    def lost(self) -> int:
        """Number of messages that the subscriber did not receive."""
        return self.published.sent - self.received.count

    @property
    def carried(self) -> bool:
        """True if all messages arrived in time and were sent in time."""
        return not self.lost and self.received.p99_ms <= MAX_LATENCY_MS and self.published.late_ms <= MAX_LATENCY_MS

    def row(self) -> list[Cell]:
        """Returns the row for the results page."""
        published, received = self.published, self.received
        percent = [
            100 * spent / published.duration_s for spent in (self.broker_s, published.processor_s, received.processor_s)
        ]
        return [
            self.kind, f"{ROBOTS} × {self.rate_hz:g}", published.sent / published.duration_s, self.lost,
            received.p50_ms, received.p99_ms, received.max_ms,
            self.broker_s / published.sent * 1e6, *percent, published.late_ms,
        ]  # fmt: skip


def measure(*, quick: bool, log: Callable[[str], None]) -> list[Run]:
    """Measures both brokers at the target rate and, unless ``quick``, at higher rates until one is not carried."""
    runs = []
    for kind, rate_hz in RATES_HZ.items():
        with (
            tempfile.TemporaryDirectory() as folder,
            start_broker(kind, Path(folder)) as broker,
            publishers_of(broker) as run,
        ):
            run(rate_hz, 1.0)
            runs.append(result := run(rate_hz, 8.0 if quick else 15.0))
            log(f"{kind}: {result.published.sent} messages, lost {result.lost}, p99 {result.received.p99_ms:.2f} ms")
            for higher_hz in () if quick else HIGHER_RATES_HZ[kind]:
                runs.append(run(higher_hz, 5.0))
                if not runs[-1].carried:
                    break
    return runs


@contextlib.contextmanager
def publishers_of(broker: RunningBroker) -> Iterator[Callable[[float, float], Run]]:
    """Connects robots and a subscriber and yields a function that runs them at a rate for a number of seconds."""
    robots = []
    for number in range(ROBOTS):
        name, topic = f"robot-{number}", f"ts/v1/lab/robot-{number}/arm/tele/joints"
        issued = broker.issue(broker.grant(name, publish=(topic,)))
        robots.append(Robot(name, issued.username, issued.password, topic))
    topic_filter = "ts/v1/lab/+/+/tele/+"
    issued = broker.issue(broker.grant("subscriber", subscribe=(topic_filter,)))
    subscriber = SubscriberOptions(broker.tcp_port, "subscriber", issued.username, issued.password, topic_filter)
    options = PublisherOptions(broker.tcp_port, robots)
    with program("subscriber", subscriber) as listener, program("publishers", options) as fleet:

        def run(rate_hz: float, seconds: float) -> Run:
            before_s = processor_s(broker.process.pid)
            published = msgspec.json.decode(request(fleet, f"{rate_hz} {seconds}"), type=PublisherResult)
            received = msgspec.json.decode(request(listener, "now"), type=SubscriberResult)
            return Run(broker.kind, rate_hz, published, received, processor_s(broker.process.pid) - before_s)

        yield run


@contextlib.contextmanager
def program(name: str, options: Any) -> Iterator["subprocess.Popen[str]"]:
    """Starts a program of the benchmark and yields it when it is ready."""
    with subprocess.Popen(
        [sys.executable, "-m", f"benchmarks.scale.{name}"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            if request(process, msgspec.json.encode(options).decode()) != "ready":
                raise RuntimeError(f"{name} did not start")
            yield process
        finally:
            process.terminate()


def request(process: "subprocess.Popen[str]", line: str) -> str:
    """Sends a line to a program and returns its response."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()
    return process.stdout.readline().strip()


def table(runs: list[Run]) -> Table:
    """Returns the table of results."""
    size = runs[0].published.message_bytes
    note = f"""{ROBOTS} connections in one program, one subscriber with QoS 0 in another, and the broker as the product
starts it: three programs on two cores. A message is the telemetry of the simulated UR5, {size:,} bytes with its topic.
p50 to max are the times from sending a message until the subscriber reads it. The last row of a broker is the first
rate that it does not carry (losses, or p99 over {MAX_LATENCY_MS:g} ms), or the highest rate tried. If messages were
sent late, the publishers were the bottleneck."""
    return Table(title="Brokers", columns=COLUMNS, rows=[run.row() for run in runs], note=note)


def claims(runs: list[Run]) -> list[Claim]:
    """Returns the targets for the target rates."""
    found = []
    for run in runs:
        if run.rate_hz == RATES_HZ[run.kind]:
            text = f"{ROBOTS} robots × {run.rate_hz:g} Hz through {run.kind} to one subscriber"
            found.append(Claim(f"{text}: lost", run.lost, 0, "messages"))
            found.append(Claim(f"{text}: p99", run.received.p99_ms, MAX_LATENCY_MS, "ms"))
    return found
