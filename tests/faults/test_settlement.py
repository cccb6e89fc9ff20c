"""An action that ended at the robot has the same result in the API, also without an ingest worker meanwhile."""

import pytest

from tests.faults.settlement import FAULTS, MAX_RECOVERY_S, Settlement
from tests.faults.stack import start
from tests.harness.network.brokers import BROKERS, BrokerKind


def run(kind: BrokerKind, faults: list[str], *, seed: int, down_s: tuple[float, ...] = (0.0,)) -> Settlement:
    """Run one round for each fault, with these times without a worker in turn."""
    with start(kind, 1) as stack:
        rounds = Settlement(stack, seed=seed)
        try:
            for number, fault in enumerate(faults):
                print(rounds.run(fault, down_s=down_s[number % len(down_s)]), flush=True)
        finally:
            rounds.close()
            print(kind, *rounds.table(), sep="\n")
    return rounds


@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", BROKERS)
def test_an_action_completed_without_a_worker_is_done(kind: BrokerKind) -> None:
    rounds = run(kind, list(FAULTS), seed=7)
    assert all(each.correct for each in rounds.results)


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", BROKERS)
def test_no_result_is_false_after_twenty_kills_of_the_worker(kind: BrokerKind) -> None:
    rounds = run(kind, [*FAULTS[:2], *FAULTS] * 5, seed=8, down_s=(0.0, 2.0, 5.0, 15.0, 0.5))
    assert len(rounds.results) >= 20
    assert all(each.correct for each in rounds.results)
    assert max(each.recovery_s for each in rounds.results) <= MAX_RECOVERY_S, "run this test on an idle machine"
