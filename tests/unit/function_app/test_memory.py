"""Programs that run for long collect garbage soon, and return large blocks to the system."""

import subprocess
import sys

import pytest

from tests.harness.paths import ROOT

GARBAGE = """
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
LARGE_BLOCKS = """
import re
import function_app

{configure}
freed = bytes(4_000_000)
del freed
block = bytes(256 * 1024)  # as asyncio reads
with open("/proc/self/maps") as maps:
    first, last = re.search(r"^(\\w+)-(\\w+) .*\\[heap\\]$", maps.read(), re.MULTILINE).groups()
print(int(first, 16) <= id(block) < int(last, 16))
"""


def shown(program: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


def test_objects_that_live_for_some_time_do_not_accumulate() -> None:
    assert int(shown(GARBAGE)) < 10_000


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has the GNU C library")
@pytest.mark.parametrize(("configure", "in_heap"), [("function_app.run_for_long()", "False"), ("", "True")])
def test_large_blocks_are_not_in_the_heap(configure: str, in_heap: str) -> None:
    assert shown(LARGE_BLOCKS.format(configure=configure)) == in_heap
