"""How far one process of ``python -m device_agent swarm`` goes, and what it asks of a broker.

``python -m benchmarks.swarm --json FILE [--broker mosquitto] [--counts 100,500] [--rates 1,5] [--seconds 15]`` starts
the functions' server, a broker and the swarm as processes of their own, and counts with ``mosquitto_sub`` how many of
the swarm's measurements a subscriber gets. Each run is added to the file as it ends. ``--credentials 800`` measures
instead what each further agent costs mosquitto, whose dynamic security writes down all it knows at each change.
"""

import argparse
import json
import os
import platform
import secrets
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from device_agent.protocol import grants, topics
from tests.support.brokers import BROKERS, HOST, ROOT, start_broker
from tests.support.ground import Ground, start_ground

_STEP = 100
LAST_S = 1.0
"""What is under way when the swarm ends is waited for."""


class Ear:
    """A subscriber of all measurements of Anna's space, in C: it must not be what is too slow."""

    def __init__(self, ground: Ground, folder: Path) -> None:
        issued = ground.anna.post("/mqtt/credentials", {"purpose": "watch"}).json()
        # It names the agents that there are; its rights are those of the space, in which more may be meanwhile.
        space = str(issued["subscribe"][0]).split("/")[2]
        everything = topics.device(space, topics.ANY, topics.ANY, topics.TELE, topics.ANY)
        self._heard = folder / "heard"
        with self._heard.open("w") as out:
            self._process = subprocess.Popen(
                [
                    "mosquitto_sub", "-h", HOST, "-p", str(ground.broker.port), "-V", "311", "-q", "0", "-F", ".",
                    "-i", issued["client_id"], "-u", issued["username"], "-P", issued["password"],
                    "-t", everything,
                ],
                stdout=out,
            )  # fmt: skip

    def end(self) -> int:
        """How many messages came."""
        time.sleep(LAST_S)
        self._process.terminate()
        self._process.wait()
        return len(self._heard.read_bytes()) // 2


def swarm(ground: Ground, home: Path, *, count: int, rate_hz: float, seconds: float, gap_s: float) -> dict[str, Any]:
    """What a swarm says of itself at its end."""
    spread_s = max(count * gap_s, 2.0)
    figures = home / "figures.json"
    subprocess.run(
        [
            sys.executable, "-m", "device_agent", "swarm", "--cloud", ground.url, "--home", str(home / "keys"),
            "--count", str(count), "--rate-hz", str(rate_hz), "--spread-s", str(spread_s), "--every-s", "5",
            "--seconds", str(spread_s + seconds), "--json", str(figures),
        ],
        cwd=ROOT,
        env={**os.environ, "TELESCOPE_TOKEN": ground.anna.token},
        check=False,
    )  # fmt: skip
    found: dict[str, Any] = json.loads(figures.read_text())
    return found


def run(ground: Ground, home: Path, *, count: int, rate_hz: float, seconds: float, gap_s: float) -> dict[str, Any]:
    """One run: what it says of itself, and what of it a subscriber has got."""
    ear = Ear(ground, home)
    load = os.getloadavg()[0]
    found = swarm(ground, home, count=count, rate_hz=rate_hz, seconds=seconds, gap_s=gap_s)
    heard = ear.end()
    # Said at QoS 1 are all but measurements.
    sent = found["counts"]["out"] - found["counts"]["asked"]
    return {
        **found,
        "measured": sent,
        "subscriber_heard": heard,
        "lost_share": round(1 - heard / max(sent, 1), 6),
        "load_before": round(load, 1),
        "load_after": round(os.getloadavg()[0], 1),
    }


def credentials(folder: Path, most: int) -> list[dict[str, float]]:
    """What it costs mosquitto to be told of one more agent, while it knows so many: processor time, not the clock's."""
    found = []
    with start_broker("mosquitto", folder) as broker:
        known, before_s = 0, _processor_s(broker.process.pid)
        while known < most:
            for _ in range(_STEP):
                known += 1
                grant = grants.agent_grant("space", f"agent{known}", token_id=secrets.token_hex(8), lifetime_s=3600)
                broker.issue(grant)
            now_s = _processor_s(broker.process.pid)
            found.append({"known": known, "processor_ms_each": round((now_s - before_s) / _STEP * 1000, 2)})
            before_s = now_s
    return found


def _processor_s(process: int) -> float:
    """Of a process and its children."""
    total = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        fields = stat.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        if int(stat.parent.name) == process or int(fields[1]) == process:
            total += int(fields[11]) + int(fields[12])
    return total / os.sysconf("SC_CLK_TCK")


def main() -> int:
    """Run all that was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--broker", choices=BROKERS, default="mosquitto")
    parser.add_argument("--counts", default="100,500,1000,2000")
    parser.add_argument("--rates", default="1,5,20")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--gap", type=float, default=0.05, help="from one connection to the next [s]")
    parser.add_argument("--credentials", type=int, default=0, metavar="AGENTS", help="only what so many cost mosquitto")
    options = parser.parse_args()
    machine = {"cores": os.cpu_count(), "python": platform.python_version(), "system": platform.platform()}
    known = json.loads(options.json.read_text()) if options.json.exists() else {"runs": []}
    if options.credentials:
        with tempfile.TemporaryDirectory() as folder:
            steps = credentials(Path(folder) / "broker", options.credentials)
        known["credentials"] = {"on": datetime.now(UTC).date().isoformat(), "machine": machine, "steps": steps}
        options.json.write_text(json.dumps(known, indent=1) + "\n")
        return 0
    with tempfile.TemporaryDirectory() as folder, start_ground(options.broker, Path(folder) / "ground") as ground:
        # The first agent makes the space one in which there is something to hear.
        swarm(ground, Path(folder), count=1, rate_hz=1, seconds=2, gap_s=0.1)
        for count in map(int, options.counts.split(",")):
            for rate_hz in map(float, options.rates.split(",")):
                found = run(
                    ground, Path(folder), count=count, rate_hz=rate_hz, seconds=options.seconds, gap_s=options.gap
                )
                made = {"broker": options.broker, "on": datetime.now(UTC).date().isoformat(), "machine": machine}
                known["runs"].append({**made, **found})
                options.json.write_text(json.dumps(known, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
