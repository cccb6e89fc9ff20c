"""Handovers of control: no command of a former holder is applied, and mutants of the gate are detected."""

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

import pytest

from device_agent.runtime.authority.lease_gate import LeaseGate
from tests.simulation.handovers import HANDOVERS, ExpiryOnly, NoCheck, Tally, simulate

WHOLE = 1_000_000
PART = 50_000


def test_no_stale_command_is_applied() -> None:
    tally = simulate(PART)
    assert tally["stale"] == 0
    assert tally["applied"] > PART / 4, "most handovers must lead to something"


@pytest.mark.parametrize("mutant", [NoCheck, ExpiryOnly])
def test_a_gate_without_fencing_is_detected(mutant: type[LeaseGate]) -> None:
    assert simulate(PART // 20, gate=mutant)["stale"] > 10


def test_a_journal_written_after_applying_is_detected() -> None:
    assert simulate(PART // 5, journal_first=False)["stale"] > 0


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_million_handovers() -> None:
    workers = os.cpu_count() or 1
    each = WHOLE // workers
    with ProcessPoolExecutor(workers) as pool:
        total: Tally = sum(pool.map(_share, range(workers), [each] * workers), Counter())
    print(total)
    assert total["handovers"] >= WHOLE - workers * HANDOVERS
    assert total["stale"] == 0


def _share(worker: int, handovers: int) -> Tally:
    return simulate(handovers, seed=10_000_000 + worker * handovers // HANDOVERS)
