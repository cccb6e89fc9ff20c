"""Processor time of mosquitto to register one more agent.

The dynamic security plugin writes its whole file at each change. Registration needs two commands (a role and a client),
so the file is written twice; the plugin has no combined command.
"""

import secrets
import tempfile
from pathlib import Path
from typing import Final

from benchmarks.reporting.report import Cell, Table
from benchmarks.scale.processes import processor_s
from device_agent.protocol.security import grants
from tests.harness.network.brokers import start_broker

STEP: Final = 100
QUICK: Final = 100
FULL: Final = 600


def measure(count: int) -> list[dict[str, float]]:
    """Adds 100 agents at a time up to a number."""
    steps: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder, start_broker("mosquitto", Path(folder)) as broker:
        before_s = processor_s(broker.process.pid)
        for registered in range(1, count + 1):
            grant = grants.agent_grant("space", f"agent{registered}", token_id=secrets.token_hex(8), lifetime_s=3600)
            broker.issue(grant)
            if registered % STEP == 0:
                now_s = processor_s(broker.process.pid)
                steps.append({"known": registered, "processor_ms_each": round((now_s - before_s) / STEP * 1000, 2)})
                before_s = now_s
    return steps


def table(steps: list[dict[str, float]]) -> Table:
    """Returns the table of results."""
    note = """Cost of registering one more agent: mosquitto's dynamic security plugin writes its whole file at each of
two commands. [scale.md](scale.md) shows the effect on a site."""
    rows: list[list[Cell]] = [[int(step["known"]), step["processor_ms_each"]] for step in steps]
    return Table(
        title="mosquitto: registered agents",
        columns=["registered agents", "ms of a core for one more"],
        rows=rows,
        note=note,
    )
