"""Many robots through one broker to one subscriber: what is lost, how late it comes, and what it costs."""

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
LATE_MS: Final = 50.0
RATES_HZ: Final[dict[BrokerKind, float]] = {"mosquitto": 50.0, "amqtt": 20.0}
"""What is claimed of each."""
HIGHER: Final[dict[BrokerKind, tuple[float, ...]]] = {
    "mosquitto": (100.0, 400.0, 800.0, 1200.0),
    "amqtt": (50.0, 100.0, 200.0, 300.0, 400.0),
}
COLUMNS: Final = [
    "broker", "robots × Hz", "messages/s", "lost", "p50 ms", "p99 ms", "most ms",
    "broker, µs of a core a message", "broker, % of a core", "robots' program, %", "subscriber, %", "sent late, p99 ms",
]  # fmt: skip


class Run(msgspec.Struct):
    """One rate, for some seconds."""

    kind: BrokerKind
    rate_hz: float
    told: PublisherResult
    heard: SubscriberResult
    broker_s: float

    @property
    def lost(self) -> int:
        """Messages that never came."""
        return self.told.sent - self.heard.count

    @property
    def carried(self) -> bool:
        """All of them, and in time: also on their way out of the robots' program."""
        return not self.lost and self.heard.p99_ms <= LATE_MS and self.told.late_ms <= LATE_MS

    def row(self) -> list[Cell]:
        """Returns the row for the results page."""
        told, heard = self.told, self.heard
        percent = [100 * spent / told.took_s for spent in (self.broker_s, told.processor_s, heard.processor_s)]
        return [
            self.kind, f"{ROBOTS} × {self.rate_hz:g}", told.sent / told.took_s, self.lost,
            heard.p50_ms, heard.p99_ms, heard.most_ms,
            self.broker_s / told.sent * 1e6, *percent, told.late_ms,
        ]  # fmt: skip


def measure(*, quick: bool, say: Callable[[str], None]) -> list[Run]:
    """Both brokers at the rate that is claimed; unless ``quick`` at higher ones too, until one does not carry it."""
    found = []
    for kind, rate_hz in RATES_HZ.items():
        with (
            tempfile.TemporaryDirectory() as folder,
            start_broker(kind, Path(folder)) as broker,
            publishers_of(broker) as ask,
        ):
            ask(rate_hz, 1.0)
            found.append(ask(rate_hz, 8.0 if quick else 15.0))
            say(f"{kind}: {found[-1].told.sent} messages, lost {found[-1].lost}, p99 {found[-1].heard.p99_ms:.2f} ms")
            for higher_hz in () if quick else HIGHER[kind]:
                found.append(ask(higher_hz, 5.0))
                if not found[-1].carried:
                    break
    return found


@contextlib.contextmanager
def publishers_of(broker: RunningBroker) -> Iterator[Callable[[float, float], Run]]:
    """Robots and their subscriber, connected; asks them for a rate and seconds."""
    robots = []
    for number in range(ROBOTS):
        name, topic = f"robot-{number}", f"ts/v1/lab/robot-{number}/arm/tele/joints"
        issued = broker.issue(broker.grant(name, publish=(topic,)))
        robots.append(Robot(name, issued.username, issued.password, topic))
    listens = "ts/v1/lab/+/+/tele/+"
    issued = broker.issue(broker.grant("ear", subscribe=(listens,)))
    ear = SubscriberOptions(broker.tcp_port, "ear", issued.username, issued.password, listens)
    options = PublisherOptions(broker.tcp_port, robots)
    with program("subscriber", ear) as listener, program("publishers", options) as fleet:

        def ask(rate_hz: float, seconds: float) -> Run:
            before_s = processor_s(broker.process.pid)
            told = msgspec.json.decode(answer(fleet, f"{rate_hz} {seconds}"), type=PublisherResult)
            heard = msgspec.json.decode(answer(listener, "now"), type=SubscriberResult)
            return Run(broker.kind, rate_hz, told, heard, processor_s(broker.process.pid) - before_s)

        yield ask


@contextlib.contextmanager
def program(name: str, asked: Any) -> Iterator["subprocess.Popen[str]"]:
    """One of the programs beside this one, once it is ready."""
    with subprocess.Popen(
        [sys.executable, "-m", f"benchmarks.scale.{name}"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            if answer(process, msgspec.json.encode(asked).decode()) != "ready":
                raise RuntimeError(f"{name} did not start")
            yield process
        finally:
            process.terminate()


def answer(process: "subprocess.Popen[str]", line: str) -> str:
    """What it says to a line."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()
    return process.stdout.readline().strip()


def table(runs: list[Run]) -> Table:
    """Returns the table of results."""
    size = runs[0].told.message_bytes
    note = f"""{ROBOTS} connections in one program, one subscriber at QoS 0 in another, the broker as the
product starts it: three programs on two cores. A message is what the simulated UR5 tells, {size:,} bytes with
its topic. p50 to most are from a message's sending to its being read by the subscriber. The last row of a
broker is the first that it no longer carries (lost, or p99 over {LATE_MS:g} ms), or the highest that was tried;
where messages were sent late, it is the robots' program that was full."""
    return Table(title="Brokers", columns=COLUMNS, rows=[run.row() for run in runs], note=note)


def claims(runs: list[Run]) -> list[Claim]:
    """Of the rates that are claimed."""
    found = []
    for run in runs:
        if run.rate_hz == RATES_HZ[run.kind]:
            what = f"{ROBOTS} robots × {run.rate_hz:g} Hz through {run.kind} to one subscriber"
            found.append(Claim(f"{what}: lost", run.lost, 0, "messages"))
            found.append(Claim(f"{what}: p99", run.heard.p99_ms, LATE_MS, "ms"))
    return found
