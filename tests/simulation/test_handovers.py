"""Handovers of control: no command of a former holder is applied, and mutants of the gate are detected."""

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

import pytest

from device_agent.runtime.authority.lease_gate import LeaseGate
from tests.simulation.handovers import HANDOVERS, ExpiryOnly, NoCheck, NoInputs, Tally, simulate

FULL_SIZE = 1_000_000
SAMPLE_SIZE = 50_000


def test_no_stale_command_is_applied() -> None:
    tally = simulate(SAMPLE_SIZE)
    assert tally["stale"] == 0
    assert tally["applied"] > SAMPLE_SIZE / 4, "most handovers must lead to applied commands"
    assert tally["resumed"] > SAMPLE_SIZE / 100, "many gaps must end with a new input"
    assert tally["ended"] > SAMPLE_SIZE / 100, "many operators must continue a held input"


@pytest.mark.parametrize("mutant", [NoCheck, ExpiryOnly, NoInputs])
def test_a_gate_without_fencing_is_detected(mutant: type[LeaseGate]) -> None:
    assert simulate(SAMPLE_SIZE // 20, gate=mutant)["stale"] > 10


def test_a_journal_written_after_applying_is_detected() -> None:
    assert simulate(SAMPLE_SIZE // 5, journal_first=False)["stale"] > 0


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_million_handovers() -> None:
    workers = os.cpu_count() or 1
    handovers = FULL_SIZE // workers
    with ProcessPoolExecutor(workers) as pool:
        total: Tally = sum(pool.map(_share, range(workers), [handovers] * workers), Counter())
    print(total)
    assert total["handovers"] >= FULL_SIZE - workers * HANDOVERS
    assert total["stale"] == 0


def _share(worker: int, handovers: int) -> Tally:
    return simulate(handovers, seed=10_000_000 + worker * handovers // HANDOVERS)
