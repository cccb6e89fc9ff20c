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
from benchmarks.scale.brokers import program, request
from benchmarks.scale.functions import FunctionsUnderTest, Load
from benchmarks.scale.http_load import Request
from benchmarks.scale.processes import processor_s, resident_mb
from benchmarks.scale.subscriber import SubscriberOptions, SubscriberResult
from device_agent.load_generator.kinematic_arm import DEVICE
from device_agent.protocol import topics
from tests.harness.browser.product import Api
from tests.harness.paths import ROOT

QUICK: Final = ((100, 5.0, 0.02),)
FULL: Final = ((100, 5.0, 0.02), (300, 5.0, 0.02), (1000, 2.0, 0.07))
"""Number of agents, measurements per second and agent, and interval between two connects [s]."""
EVERY_S: Final = 1.0
ARMS: Final = 60
"""Agents that receive actions: several per client."""
ARMS_HZ: Final = 20.0
"""An agent notices its arrival at the next measurement."""
COLUMNS: Final = [
    "agents", "Hz", "registered in s", "connected", "connects/s", "messages/s", "lost", "p50 ms", "p99 ms", "max ms",
    "broker, % of a core", "load test, %", "broker MB", "functions MB", "load test, kB per agent",
]  # fmt: skip


class LoadTestResult(msgspec.Struct):
    """Result of one run. ``figures`` is the summary of the load generator."""

    registered_s: float
    connects_per_s: float
    figures: dict[str, Any]
    received: SubscriberResult
    broker_percent: float
    broker_mb: float
    functions_mb: float
    load_before: float
    load_after: float

    @property
    def measured(self) -> int:
        """Sent measurements: all messages with QoS 0."""
        counts: dict[str, int] = self.figures["counts"]
        return counts["out"] - counts["out_qos1"]

    @property
    def lost(self) -> int:
        """Measurements that the subscriber did not receive."""
        return self.measured - self.received.count

    def row(self) -> list[Cell]:
        """Returns the row for the results page."""
        figures, received = self.figures, self.received
        return [
            figures["agents"], figures["rate_hz"], self.registered_s, figures["most_connected"], self.connects_per_s,
            figures["out_per_s"], self.lost, received.p50_ms, received.p99_ms, received.max_ms,
            self.broker_percent, 100 * figures["cpu_share"],
            self.broker_mb, self.functions_mb, figures["memory_bytes_per_agent"] / 1000,
        ]  # fmt: skip

    def cost_model_values(self) -> dict[str, Any]:
        """Returns the values for the cost model."""
        return {
            "broker": "mosquitto",
            "on": datetime.now(UTC).date().isoformat(),
            **self.figures,
            "measured": self.measured,
            "subscriber_received": self.received.count,
            "lost_share": round(self.lost / max(self.measured, 1), 6),
            "load_before": self.load_before,
            "load_after": self.load_after,
        }


class LoadTest:
    """A load generator that runs for some seconds, with one subscriber.

    Args:
        product: The product.
        home: Folder of the agents' keys; a later run with the same folder uses the same agents.
    """

    def __init__(self, product: MeasuredProduct, home: Path) -> None:
        self._product = product
        self._home = home

    @contextlib.contextmanager
    def running(self, count: int, rate_hz: float, seconds: float, gap_s: float) -> Iterator["subprocess.Popen[str]"]:
        """Runs the load generator while it connects and publishes."""
        with subprocess.Popen(
            [
                sys.executable, "-m", "device_agent", "load-test", "--cloud", self._product.machine.url,
                "--home", str(self._home / "keys"), "--count", str(count), "--rate-hz", str(rate_hz),
                "--spread-s", str(count * gap_s), "--seconds", str(count * gap_s + seconds), "--every-s", str(EVERY_S),
                "--json", str(self._home / "figures.json"),
            ],
            cwd=ROOT,
            env={**os.environ, "TELESCOPE_SIGN_IN": self._product.machine.sign_in_link()},
            stdout=subprocess.PIPE,
            text=True,
        ) as process:  # fmt: skip
            try:
                yield process
            finally:
                process.terminate()
                process.communicate()  # the program prints a summary when it ends

    def run(self, count: int, rate_hz: float, gap_s: float, seconds: float) -> LoadTestResult:
        """Measures the run from the first key to the last message."""
        topic_filter = topics.device(topics.ANY, topics.ANY, DEVICE, topics.TELE, topics.ANY)
        subscriber = SubscriberOptions(
            self._product.mqtt_port, *self._product.credentials(subscribe=(topic_filter,)), topic_filter, wall=True
        )
        broker = self._product.machine.pid("infra.mosquitto")
        load, started_s = os.getloadavg()[0], time.monotonic()
        with program("subscriber", subscriber) as listener, self.running(count, rate_hz, seconds, gap_s) as process:
            progress = _Progress(process, count)
            registered_s = progress.first_s - started_s
            progress.wait()
            before_s, connected_s = processor_s(broker), time.monotonic()
            megabytes = resident_mb(broker), resident_mb(self._product.machine.pid("function_app serve"))
            process.wait(TIMEOUT_S + count * gap_s + seconds)
            percent = 100 * (processor_s(broker) - before_s) / (time.monotonic() - connected_s)
            received = msgspec.json.decode(request(listener, "now"), type=SubscriberResult)
        return LoadTestResult(
            registered_s=registered_s,
            connects_per_s=count / (progress.last_s - progress.first_s) if progress.last_s else 0.0,
            figures=json.loads((self._home / "figures.json").read_text()),
            received=received,
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
        self._complete = f"{count} of {count} connected"
        self.last_s = 0.0
        line = self._line()
        while line and "connected" not in line:
            line = self._line()
        self.first_s = time.monotonic() - EVERY_S
        self._update(line)

    def wait(self) -> None:
        """Waits until all agents are connected or the program has ended."""
        while not self.last_s and (line := self._line()):
            self._update(line)

    def _update(self, line: str) -> None:
        if self._complete in line:
            self.last_s = time.monotonic()

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


def actions(
    site: FunctionsUnderTest, product: MeasuredProduct, home: Path, *, seconds: float, processes: tuple[int, ...]
) -> list[Load]:
    """Measures accepted actions per second for arms that reach each target immediately."""
    found = []
    longest_s = len(processes) * (seconds + 1) + TIMEOUT_S
    with contextlib.ExitStack() as stack, LoadTest(product, home).running(ARMS, ARMS_HZ, longest_s, 0.02) as process:
        _Progress(process, ARMS).wait()
        devices = _online_arms(product)
        request = {"kind": "move_joints", "position_rad": {"joint_1": 0.0}}
        body = json.dumps({"request": request, "wait_for": "done", "wait_ms": 10_000})
        requests = [
            Request("POST", f"/api/v1/devices/{device}/actions", product.token, body) for device in devices[:ARMS]
        ]
        for count in processes:
            site.grow(count)
            run = site.clients("POST actions", count, requests, stack)
            run(0.5)
            found.append(run(seconds))
    return found


def _online_arms(product: MeasuredProduct) -> list[str]:
    """Returns the ids of the arms that are online; the list also contains agents of earlier runs."""
    found: list[str] = []
    query: dict[str, Any] = {"limit": 1000}
    with Api(product.machine) as owner:
        while True:
            page = owner.get("/devices", **query)
            found += [each["id"] for each in page["items"] if each["name"] == DEVICE and each["online"]]
            if page["cursor"] is None:
                return found
            query["cursor"] = page["cursor"]


def table(runs: list[LoadTestResult]) -> Table:
    """Returns the table of results."""
    note = """`python -m device_agent load-test`: agents with the real protocol in one process, without physics, at the
product over mosquitto, with one subscriber to all measurements. *Registered*: keys, enrolment and claims of new agents
over HTTP. *Connects*: credentials and connection at the configured pace or slower. mosquitto writes its whole
permission file at each new agent and forwards no messages during the write. p50 to max are from an agent's measurement
to the subscriber over the whole run, including connecting. Processor time is that of the time after connecting."""
    return Table(title="Load-test agents", columns=COLUMNS, rows=[run.row() for run in runs], note=note)
