"""Load test of the product with many agents: connections, messages, losses, actions and memory."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec

from benchmarks.baseline.product import TIMEOUT_S, MeasuredProduct
from benchmarks.reporting.report import Cell, Table
from benchmarks.scale.brokers import answer, program
from benchmarks.scale.functions import FunctionsUnderTest, Load
from benchmarks.scale.http_load import Request
from benchmarks.scale.processes import processor_s, resident_mb
from benchmarks.scale.subscriber import SubscriberOptions, SubscriberResult
from device_agent.load_generator.kinematic_arm import DEVICE
from device_agent.protocol import topics
from tests.harness.browser.product import Api
from tests.harness.paths import ROOT

QUICK: Final = ((100, 5.0, 0.02),)
WHOLE: Final = ((100, 5.0, 0.02), (300, 5.0, 0.02), (1000, 2.0, 0.07))
"""Number of agents, measurements per second and agent, and interval between two connects [s]."""
EVERY_S: Final = 1.0
ARMS: Final = 60
"""Agents that receive actions: several per client."""
ARMS_HZ: Final = 20.0
"""An agent notices its arrival at the next measurement."""
COLUMNS: Final = [
    "agents", "Hz", "made known in s", "connected", "connects/s", "messages/s", "lost", "p50 ms", "p99 ms", "most ms",
    "broker, % of a core", "swarm, %", "broker MB", "functions MB", "swarm kB an agent",
]  # fmt: skip


class LoadTestResult(msgspec.Struct):
    """Result of one run. ``figures`` is the summary of the load generator."""

    known_s: float
    connects_per_s: float
    figures: dict[str, Any]
    heard: SubscriberResult
    broker_percent: float
    broker_mb: float
    functions_mb: float
    load_before: float
    load_after: float

    @property
    def measured(self) -> int:
        """Sent measurements: all messages with QoS 0."""
        counts: dict[str, int] = self.figures["counts"]
        return counts["out"] - counts["asked"]

    @property
    def lost(self) -> int:
        """Measurements that the subscriber did not receive."""
        return self.measured - self.heard.count

    def row(self) -> list[Cell]:
        """Returns the row for the results page."""
        told, heard = self.figures, self.heard
        return [
            told["agents"], told["rate_hz"], self.known_s, told["most_connected"], self.connects_per_s,
            told["out_per_s"], self.lost, heard.p50_ms, heard.p99_ms, heard.most_ms,
            self.broker_percent, 100 * told["cpu_share"],
            self.broker_mb, self.functions_mb, told["memory_bytes_per_agent"] / 1000,
        ]  # fmt: skip

    def kept(self) -> dict[str, Any]:
        """Returns the values for the cost model."""
        return {
            "broker": "mosquitto",
            "on": datetime.now(UTC).date().isoformat(),
            **self.figures,
            "measured": self.measured,
            "subscriber_heard": self.heard.count,
            "lost_share": round(self.lost / max(self.measured, 1), 6),
            "load_before": self.load_before,
            "load_after": self.load_after,
        }


class LoadTest:
    """A load generator that runs for some seconds, with one subscriber.

    Args:
        stand: The product.
        home: Folder of the agents' keys; a later run with the same folder uses the same agents.
    """

    def __init__(self, stand: MeasuredProduct, home: Path) -> None:
        self._stand = stand
        self._home = home

    @contextlib.contextmanager
    def living(self, count: int, rate_hz: float, seconds: float, gap_s: float) -> Iterator["subprocess.Popen[str]"]:
        """Runs the load generator while it connects and publishes."""
        with subprocess.Popen(
            [
                sys.executable, "-m", "device_agent", "load-test", "--cloud", self._stand.machine.url,
                "--home", str(self._home / "keys"), "--count", str(count), "--rate-hz", str(rate_hz),
                "--spread-s", str(count * gap_s), "--seconds", str(count * gap_s + seconds), "--every-s", str(EVERY_S),
                "--json", str(self._home / "figures.json"),
            ],
            cwd=ROOT,
            env={**os.environ, "TELESCOPE_SIGN_IN": self._stand.machine.sign_in_link()},
            stdout=subprocess.PIPE,
            text=True,
        ) as process:  # fmt: skip
            try:
                yield process
            finally:
                process.terminate()
                process.communicate()  # it announces its end

    def run(self, count: int, rate_hz: float, gap_s: float, seconds: float) -> LoadTestResult:
        """Measures the run from the first key to the last message."""
        everything = topics.device(topics.ANY, topics.ANY, DEVICE, topics.TELE, topics.ANY)
        ear = SubscriberOptions(
            self._stand.mqtt_port, *self._stand.rights(subscribe=(everything,)), everything, wall=True
        )
        broker = self._stand.machine.pid("infra.mosquitto")
        load, began_s = os.getloadavg()[0], time.monotonic()
        with program("subscriber", ear) as listener, self.living(count, rate_hz, seconds, gap_s) as process:
            progress = _Progress(process, count)
            known_s = progress.first_s - began_s
            progress.wait()
            before_s, all_s = processor_s(broker), time.monotonic()
            megabytes = resident_mb(broker), resident_mb(self._stand.machine.pid("function_app serve"))
            process.wait(TIMEOUT_S + count * gap_s + seconds)
            percent = 100 * (processor_s(broker) - before_s) / (time.monotonic() - all_s)
            heard = msgspec.json.decode(answer(listener, "now"), type=SubscriberResult)
        return LoadTestResult(
            known_s=known_s,
            connects_per_s=count / (progress.all_s - progress.first_s) if progress.all_s else 0.0,
            figures=json.loads((self._home / "figures.json").read_text()),
            heard=heard,
            broker_percent=percent,
            broker_mb=megabytes[0],
            functions_mb=megabytes[1],
            load_before=round(load, 1),
            load_after=round(os.getloadavg()[0], 1),
        )


class _Progress:
    """Times of the first and the last connection; the load generator prints one line per second."""

    def __init__(self, process: "subprocess.Popen[str]", count: int) -> None:
        self._process = process
        self._all = f"{count} of {count} connected"
        self.all_s = 0.0
        line = self._line()
        while line and "connected" not in line:
            line = self._line()
        self.first_s = time.monotonic() - EVERY_S
        self._look(line)

    def wait(self) -> None:
        """Waits until all agents are connected or the program has ended."""
        while not self.all_s and (line := self._line()):
            self._look(line)

    def _look(self, line: str) -> None:
        if self._all in line:
            self.all_s = time.monotonic()

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


def actions(
    site: FunctionsUnderTest, stand: MeasuredProduct, home: Path, *, seconds: float, processes: tuple[int, ...]
) -> list[Load]:
    """Measures accepted actions per second for arms that reach each target at once."""
    found = []
    longest_s = len(processes) * (seconds + 1) + TIMEOUT_S
    with contextlib.ExitStack() as stack, LoadTest(stand, home).living(ARMS, ARMS_HZ, longest_s, 0.02) as process:
        _Progress(process, ARMS).wait()
        devices = _there(stand)
        request = {"kind": "move_joints", "position_rad": {"joint_1": 0.0}}
        body = json.dumps({"request": request, "wait_for": "done", "wait_ms": 10_000})
        asked = [Request("POST", f"/api/v1/devices/{device}/actions", stand.token, body) for device in devices[:ARMS]]
        for count in processes:
            site.grow(count)
            ask = site.ask("POST actions", count, asked, stack)
            ask(0.5)
            found.append(ask(seconds))
    return found


def _there(stand: MeasuredProduct) -> list[str]:
    """Returns the ids of the arms that are online; the list also contains agents of earlier runs."""
    found: list[str] = []
    query: dict[str, Any] = {"limit": 1000}
    with Api(stand.machine) as owner:
        while True:
            page = owner.get("/devices", **query)
            found += [each["id"] for each in page["items"] if each["name"] == DEVICE and each["online"]]
            if page["cursor"] is None:
                return found
            query["cursor"] = page["cursor"]


def table(runs: list[LoadTestResult]) -> Table:
    """Returns the table of results."""
    note = """`python -m device_agent load-test`: agents that are real ones on the wire, in one process, without
physics, at the product over mosquitto; one subscriber to all that they measure. *Made known*: keys, enrolment
and claim of those that were not known yet, over HTTP. *Connects*: credentials and the connection, at the pace
that the swarm was given, or slower; mosquitto writes all the rights that it knows to its file at each new one,
and passes nothing on meanwhile: p50 to most, from an agent's measurement to the subscriber, are of the whole
run, with connecting. Processor time is of the seconds after."""
    return Table(title="A swarm", columns=COLUMNS, rows=[run.row() for run in runs], note=note)
