"""A swarm through the product: connections, messages, what is lost, actions through the store, and memory."""

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
"""Agents, the measurements of each a second, and the time from one's connecting to the next one's [s]."""
EVERY_S: Final = 1.0
ARMS: Final = 60
"""Of those that take actions: several for each client."""
ARMS_HZ: Final = 20.0
"""They notice at their next measurement that they have arrived."""
COLUMNS: Final = [
    "agents", "Hz", "made known in s", "connected", "connects/s", "messages/s", "lost", "p50 ms", "p99 ms", "most ms",
    "broker, % of a core", "swarm, %", "broker MB", "functions MB", "swarm kB an agent",
]  # fmt: skip


class LoadTestResult(msgspec.Struct):
    """One run. ``figures`` is what the swarm says of itself."""

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
        """Measurements that it sent: all that is not told at QoS 1."""
        counts: dict[str, int] = self.figures["counts"]
        return counts["out"] - counts["asked"]

    @property
    def lost(self) -> int:
        """Measurements that the subscriber did not get."""
        return self.measured - self.heard.count

    def row(self) -> list[Cell]:
        """As the page shows it."""
        told, heard = self.figures, self.heard
        return [
            told["agents"], told["rate_hz"], self.known_s, told["most_connected"], self.connects_per_s,
            told["out_per_s"], self.lost, heard.p50_ms, heard.p99_ms, heard.most_ms,
            self.broker_percent, 100 * told["cpu_share"],
            self.broker_mb, self.functions_mb, told["memory_bytes_per_agent"] / 1000,
        ]  # fmt: skip

    def kept(self) -> dict[str, Any]:
        """As the sheet on paper reads it."""
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
    """A swarm that lives for some seconds, with a subscriber beside it.

    Args:
        stand: The product.
        home: Where its keys are: the next one of the same home is known already.
    """

    def __init__(self, stand: MeasuredProduct, home: Path) -> None:
        self._stand = stand
        self._home = home

    @contextlib.contextmanager
    def living(self, count: int, rate_hz: float, seconds: float, gap_s: float) -> Iterator["subprocess.Popen[str]"]:
        """It, while it connects and lives."""
        with subprocess.Popen(
            [
                sys.executable, "-m", "device_agent", "swarm", "--cloud", self._stand.machine.url,
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
                process.communicate()  # it says goodbye

    def run(self, count: int, rate_hz: float, gap_s: float, seconds: float) -> LoadTestResult:
        """From the first key to the last word."""
        everything = topics.device(topics.ANY, topics.ANY, DEVICE, topics.TELE, topics.ANY)
        ear = SubscriberOptions(
            self._stand.mqtt_port, *self._stand.rights(subscribe=(everything,)), everything, wall=True
        )
        broker = self._stand.machine.pid("infra.mosquitto")
        load, began_s = os.getloadavg()[0], time.monotonic()
        with program("ear", ear) as listener, self.living(count, rate_hz, seconds, gap_s) as process:
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
    """When the first agents connected, and the last: the swarm says a line a second."""

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
        """Until all are connected, or it has ended."""
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
    """As many as are taken, by so many processes, for the arms of a swarm, which are where they are asked to be."""
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
    """Ids of the arms that are online: others of an earlier swarm are known too."""
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
    """What was found."""
    note = """`python -m device_agent swarm`: agents that are real ones on the wire, in one process, without
physics, at the product over mosquitto; one subscriber to all that they measure. *Made known*: keys, enrolment
and claim of those that were not known yet, over HTTP. *Connects*: credentials and the connection, at the pace
that the swarm was given, or slower; mosquitto writes all the rights that it knows to its file at each new one,
and passes nothing on meanwhile: p50 to most, from an agent's measurement to the subscriber, are of the whole
run, with connecting. Processor time is of the seconds after."""
    return Table(title="A swarm", columns=COLUMNS, rows=[run.row() for run in runs], note=note)
