"""Real-time factor of the simulated laboratory and cost of each part of the agent.

``python -m benchmarks.agent.laboratory [SECONDS] [--broker amqtt]`` starts the product in its own folder and on its own
ports. All robots run movements continuously; each publishes joints at 50 Hz, and two colour cameras deliver ten
images of 320x240 pixels per second. After a warm-up of 30 s it measures for ``SECONDS`` (60) and prints

- the real-time factor of the simulation and the lost simulated time;
- the processor time of each part of the agent in per cent of one core (``/proc/self/task``);
- the lateness of control loops: interval between two decisions minus the period;
- the load from other programs.
"""

import argparse
import contextlib
import json
import os
import platform
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.reporting.report import percentile
from device_agent import __main__ as agent
from device_agent.config.catalogue import ROOMS
from device_agent.runtime.control import control_loop
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.controller import Controller
from device_agent.simulation import world_registry
from infra.local import __main__ as local
from infra.local import settings

ROOM = "lab"
TELEMETRY_HZ = 50.0
WARM_UP_S = 30.0
MOVEMENTS = {"ur5": "slow_square", "nao": "wave", "qbo": "patrol", "hanson": "look_around"}
"""Movement that each robot repeats."""
PARTS = (
    ("physics", ("mujoco-world",)),
    ("control loops", ("-loop",)),
    ("camera rendering", ("renderer", "llvmpipe")),
    ("perception", ("perception",)),
    ("sensors, JPEG", ("-sensing", "-camera")),
    ("other streams of the robots", ("-stream",)),
    ("network", ("mqtt", "outbox", "paho")),
    ("commands, journal, events", ("-commands", "action-", "script-")),
)
OTHER = "other"
DIVIDER = "--"
"""Separates the options of the benchmark from those of the agent."""
SHOWN_PERCENT = 0.3
_TICKS_S = os.sysconf("SC_CLK_TCK")
_SHARES = (0.5, 0.95, 0.99, 1.0)


# ------------------------------------------------------------ in the agent's process


def run_agent(report: Path, for_s: float, arguments: Sequence[str]) -> int:
    """Runs the agent with an observer of its threads."""
    gaps: dict[str, list[float]] = {}
    last: dict[str, float] = {}
    update = Controller.update

    def timed(controller: Controller, *args: Any, **kwargs: Any) -> ControlOutput:
        name, at_s = threading.current_thread().name, time.monotonic()
        if name in last:
            gaps.setdefault(name, []).append(at_s - last[name])
        last[name] = at_s
        return update(controller, *args, **kwargs)

    Controller.update = timed  # type: ignore[method-assign,assignment]
    control_loop.IDLE_RATE_HZ = TELEMETRY_HZ
    threading.Thread(target=_watch, args=(report, for_s, gaps), name="bench", daemon=True).start()
    return agent.main(arguments)


def _watch(report: Path, for_s: float, gaps: dict[str, list[float]]) -> None:
    time.sleep(WARM_UP_S)
    world = world_registry.get_world(ROOMS.folder(ROOM))
    gaps.clear()
    before, busy, started_s = _threads(), _busy_s(), time.monotonic()
    first, process_s = world.snapshot(), time.process_time()
    time.sleep(for_s)
    last, duration_s = world.snapshot(), time.monotonic() - started_s
    after = _threads()
    used_s = time.process_time() - process_s
    cost: dict[str, float] = {}
    for name, spent_s in after.items():
        part = _part(name)
        cost[part] = cost.get(part, 0.0) + spent_s - before.get(name, 0.0)
    other_percent = {
        name: (spent - before.get(name, 0.0)) / duration_s * 100
        for name, spent in after.items()
        if _part(name) == OTHER
    }
    other_percent["threads that ended"] = (used_s - sum(cost.values())) / duration_s * 100
    cost[OTHER] = used_s - sum(spent for part, spent in cost.items() if part != OTHER)
    result = {
        "factor": (last.time_s - first.time_s) / duration_s,
        "lost_ms": last.lag_ms - first.lag_ms,
        "cost_percent": {part: spent_s / duration_s * 100 for part, spent_s in cost.items()},
        "other_percent": {name: percent for name, percent in other_percent.items() if percent >= SHOWN_PERCENT},
        "agent_percent": used_s / duration_s * 100,
        "others_percent": (_busy_s() - busy - used_s) / duration_s * 100,
        "gaps_ms": {
            name: [len(each), *([round(percentile(each, share) * 1000, 2) for share in _SHARES])]
            for name, each in sorted(gaps.items())
            if name.endswith("-loop") and each
        },
    }
    report.write_text(json.dumps(result))


def _threads() -> dict[str, float]:
    """Returns the processor time of each thread by name [s]; native threads have the name that their library sets."""
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    seconds: dict[str, float] = {}
    for task in Path("/proc/self/task").iterdir():
        try:
            before, _, after = (task / "stat").read_text(encoding="ascii").rpartition(")")
        except OSError:  # the thread has ended
            continue
        spent, name = after.split(), names.get(int(task.name), before.partition("(")[2])
        seconds[name] = seconds.get(name, 0.0) + (int(spent[11]) + int(spent[12])) / _TICKS_S
    return seconds


def _busy_s() -> float:
    """Returns the non-idle processor time of the machine [s]."""
    spent = [int(each) for each in Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:9]]
    return (sum(spent) - spent[3] - spent[4]) / _TICKS_S


def _part(thread: str) -> str:
    return next((part for part, names in PARTS if any(name in thread for name in names)), OTHER)


# ------------------------------------------------------------ in the benchmark's process


class Laboratory(local.LocalStack):
    """The product with an observed agent."""

    def __init__(self, chosen: settings.Settings, report: Path, for_s: float) -> None:
        super().__init__(chosen)
        self._report = report
        self._for_s = for_s
        self._token = ""

    def _run(self, name: str, *arguments: str) -> Any:
        if name == "agent":
            module = ("benchmarks.agent.laboratory", str(self._for_s), "--agent", str(self._report))
            arguments = ("-m", *module, DIVIDER, *arguments[2:])
        return super()._run(name, *arguments)

    def operate(self, stopping: threading.Event) -> None:
        """Keeps all robots in motion."""
        link = self._sign_in_link().partition("#sign-in=")[2].split()[0]
        signed_in = self._call("POST", "/auth/sign-in", {"link": link})["access_token"]
        request = {"name": "benchmark", "role": "operator", "days": 1}
        self._token = self._call("POST", "/api-keys", request, signed_in)["token"]
        while not stopping.wait(1.0):
            for device in self._call("GET", "/devices", token=self._token)["items"]:
                if device["robot_type"] in MOVEMENTS:
                    body = {"request": {"kind": "run_movement", "name": MOVEMENTS[device["robot_type"]]}}
                    # The server rejects an action while the robot moves.
                    with contextlib.suppress(ValueError, OSError):
                        self._call("POST", f"/devices/{device['id']}/actions", body, self._token)


def show(result: dict[str, Any], for_s: float, broker: str) -> None:
    """Prints the results."""
    print(f"{platform.python_version()}, {os.cpu_count()} cores, {broker}, {for_s:.0f} s")
    print(f"real-time factor {result['factor']:.4f}, {result['lost_ms']:.0f} ms of simulated time lost")
    for part, percent in sorted(result["cost_percent"].items(), key=lambda entry: -entry[1]):
        print(f"  {part:28}{percent:6.1f} % of a core")
    for name, percent in result["other_percent"].items():
        print(f"    of which {name:19}{percent:6.1f} %")
    print(f"  {'agent, total':28}{result['agent_percent']:6.1f} %")
    print(f"  {'other programs':28}{result['others_percent']:6.1f} %")
    print(f"{'ms between two decisions':30}{'n':>8}{'p50':>8}{'p95':>8}{'p99':>8}{'max':>8}")
    for name, (count, *percentiles) in result["gaps_ms"].items():
        print(f"  {name:28}{count:8}" + "".join(f"{value:8.2f}" for value in percentiles))


def measure(for_s: float, broker: str, port: int) -> None:
    """Starts the product, measures and stops it."""
    with tempfile.TemporaryDirectory(prefix="ts-bench-lab-") as folder:
        report = Path(folder) / "report.json"
        values = {"HOME": folder, "PORT": str(port), "BROKER": broker, "ROOM": ROOM}
        chosen = settings.read(os.environ | {f"TELESCOPE_{name}": value for name, value in values.items()})
        laboratory = Laboratory(chosen, report, for_s)
        stopping = threading.Event()
        try:
            laboratory.start()
            operator = threading.Thread(target=laboratory.operate, args=(stopping,), name="operator", daemon=True)
            operator.start()
            deadline_s = time.monotonic() + WARM_UP_S + for_s + 60
            while not report.is_file():
                if time.monotonic() > deadline_s:
                    sys.exit(f"no report; see {folder}")
                time.sleep(0.5)
            time.sleep(0.5)
            show(json.loads(report.read_text()), for_s, broker)
        finally:
            stopping.set()
            laboratory.stop()


def main() -> int:
    """Runs the command line."""
    parser = argparse.ArgumentParser(description="Measure the laboratory in real time.")
    parser.add_argument("seconds", type=float, nargs="?", default=60.0)
    parser.add_argument("--broker", choices=["amqtt", "mosquitto"], default="amqtt")
    parser.add_argument("--port", type=int, default=8600, help="first of three ports")
    parser.add_argument("--agent", type=Path, help=argparse.SUPPRESS)
    own = sys.argv[1 : sys.argv.index(DIVIDER)] if DIVIDER in sys.argv else sys.argv[1:]
    chosen = parser.parse_args(own)
    if chosen.agent is not None:
        return run_agent(chosen.agent, chosen.seconds, sys.argv[len(own) + 2 :])
    measure(chosen.seconds, chosen.broker, chosen.port)
    return 0


if __name__ == "__main__":
    sys.exit(main())
