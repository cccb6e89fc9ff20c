"""Garbage of connections is collected soon, although many objects of the embedded broker stay."""

import subprocess
import sys

from tests.harness.paths import ROOT

PROGRAM = """
import gc
from collections import deque

import function_app
from infra.embedded_broker.__main__ import FULL_COLLECTION

stays = [[] for _ in range(200_000)]
function_app.run_for_long()
gc.set_threshold(gc.get_threshold()[0], *FULL_COLLECTION)
alive = deque(maxlen=2_000)  # each object outlives the first collection, as those of a connection do
for _ in range(50_000):
    cycle = []
    cycle.append(cycle)
    alive.append(cycle)
print(len(gc.get_objects()))
"""


def test_objects_that_live_for_some_time_do_not_accumulate() -> None:
    run = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, check=True)
    assert int(run.stdout) < 10_000
