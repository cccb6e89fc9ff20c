"""What it costs mosquitto to be told of one more agent: its dynamic security writes down all it knows at each change.

Two commands, a role and a client, are two times all of it: the plugin offers nothing that would be one. Processor time,
and not the clock's.
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
WHOLE: Final = 600


def measure(most: int) -> list[dict[str, float]]:
    """Adds 100 agents at a time up to a number."""
    found: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder, start_broker("mosquitto", Path(folder)) as broker:
        before_s = processor_s(broker.process.pid)
        for known in range(1, most + 1):
            grant = grants.agent_grant("space", f"agent{known}", token_id=secrets.token_hex(8), lifetime_s=3600)
            broker.issue(grant)
            if known % STEP == 0:
                now_s = processor_s(broker.process.pid)
                found.append({"known": known, "processor_ms_each": round((now_s - before_s) / STEP * 1000, 2)})
                before_s = now_s
    return found


def table(steps: list[dict[str, float]]) -> Table:
    """Returns the table of results."""
    note = """Rights for one more agent, after so many: mosquitto's dynamic security writes all of them to its file at
each of two commands. What that means for a site: [scale.md](scale.md)."""
    rows: list[list[Cell]] = [[int(step["known"]), step["processor_ms_each"]] for step in steps]
    return Table(
        title="mosquitto's rights", columns=["agents known", "ms of a core for each more"], rows=rows, note=note
    )
