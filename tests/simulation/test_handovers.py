"""Handovers of control: no command of a former holder is applied, and mutants of the gate are detected."""

import os
import time
from concurrent.futures import ProcessPoolExecutor

import pytest

from tests.simulation.handovers import HANDOVERS, MakeGate, Tally, expiry_only, no_check, simulate

WHOLE = 1_000_000
PART = 50_000


def test_no_stale_command_is_applied() -> None:
    tally = simulate(PART)
    assert tally.stale == 0
    assert tally.applied > PART / 4, "most handovers must lead to something"


@pytest.mark.parametrize("mutant", [no_check, expiry_only])
def test_a_gate_without_fencing_is_detected(mutant: MakeGate) -> None:
    assert simulate(PART // 20, gate=mutant).stale > 10


def test_a_journal_written_after_applying_is_detected() -> None:
    assert simulate(PART // 5, journal_first=False).stale > 0


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_million_handovers() -> None:
    began_s = time.monotonic()
    workers = os.cpu_count() or 1
    each = WHOLE // workers
    with ProcessPoolExecutor(workers) as pool:
        tallies: list[Tally] = list(pool.map(_share, range(workers), [each] * workers))
    total = sum(tally.handovers for tally in tallies)
    print(
        f"{total} handovers, {sum(tally.delivered for tally in tallies)} messages, "
        f"{sum(tally.applied for tally in tallies)} commands applied, "
        f"{sum(tally.stale for tally in tallies)} of them stale; {time.monotonic() - began_s:.0f} s"
    )
    assert total >= WHOLE
    assert sum(tally.stale for tally in tallies) == 0


def _share(worker: int, handovers: int) -> Tally:
    return simulate(handovers, seed=10_000_000 + worker * handovers // HANDOVERS)
