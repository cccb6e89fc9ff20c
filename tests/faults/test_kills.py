"""A kill of any program of a supervised product neither loses nor duplicates an action nor makes its result false."""

import pytest

from benchmarks.faults.kills import PROGRAMS, KillRuns
from benchmarks.suites.kills import MAX_RECOVERY_S
from tests.harness.network.brokers import BROKERS, BrokerKind


def run(kind: BrokerKind, count: int, seed: int) -> KillRuns:
    with KillRuns(kind, seed=seed) as runs:
        runs.run(count, print)
        verdict = runs.verdict()
    print(verdict)
    assert verdict.accepted >= count
    assert (verdict.lost, verdict.duplicated, verdict.false) == (0, 0, [])
    return runs


@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", BROKERS)
def test_actions_have_true_results_after_one_kill_of_each_program(kind: BrokerKind) -> None:
    runs = run(kind, len(PROGRAMS), seed=1)
    assert {each.program for each in runs.kills} == set(PROGRAMS)


@pytest.mark.long
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", BROKERS)
def test_actions_have_true_results_after_250_kills(kind: BrokerKind) -> None:
    runs = run(kind, 250, seed=2)
    assert max(each.recovery_s for each in runs.kills) <= MAX_RECOVERY_S, "run this test on an idle machine"
