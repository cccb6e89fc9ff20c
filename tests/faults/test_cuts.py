"""A moving arm is at rest 350 ms after any interruption, until an operator takes control again."""

import random

import pytest

from tests.faults.cuts import OPERATOR, SCRIPT, SHARED, Bench, Tally
from tests.faults.gaps import inject, table
from tests.faults.judge import Row, judge
from tests.faults.stack import start
from tests.harness.network.brokers import BROKERS, BrokerKind

EVERY_ROUND_MS = 10.0


def bench(
    kind: BrokerKind, arms: int, plan: list[str], *, rounds: int, seed: int, more: int = 0, watchdog_s: float = 0.3
) -> Tally:
    """Run the cuts of ``plan``, which affect all arms, and ``rounds`` cuts of each operator after each of them.

    Args:
        more: Additional operator cuts at the end.
    """
    with start(kind, arms, watchdog_s=watchdog_s) as stack:
        runner = Bench(stack, seed=seed)
        try:
            for cut in ("", *plan):
                if cut:
                    runner.cut_all_arms(cut)
                runner.cut_each_operator(rounds)
            runner.cut_each_operator(more)
        finally:
            runner.close()
            print(*runner.tally.table(), f"repeated {runner.tally.repeated}", sep="\n")
            print(*runner.tally.broken, sep="\n")
    return runner.tally


def test_a_moving_arm_rests_in_time_after_each_kind_of_cut() -> None:
    tally = bench("amqtt", 3, ["agent disconnected", "script's processes killed"], rounds=2, seed=4)
    assert not tally.broken
    assert tally.count >= 20


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", BROKERS)
def test_a_moving_arm_rests_in_time_after_a_thousand_cuts(kind: BrokerKind) -> None:
    plan = [*SHARED, *SCRIPT] * 4
    random.Random(4).shuffle(plan)
    tally = bench(kind, 4, plan, rounds=3, seed=5, more=10)
    assert not tally.broken
    assert not tally.late, "run this test on an idle machine; late results are failures"
    assert tally.count >= 500


@pytest.mark.parametrize("count", [6, pytest.param(200, marks=[pytest.mark.long, pytest.mark.timeout(1800)])])
def test_an_arm_rests_in_each_gap_and_only_a_new_input_moves_it_under_the_same_lease(count: int) -> None:
    with start("mosquitto", 3) as stack:
        gaps = inject(stack, count, seed=7)
    print(table(gaps))
    assert [gap for gap in gaps if gap.broken] == []
    assert sum(gap.held for gap in gaps) > count / 2


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_watchdog_of_one_second_is_detected() -> None:
    tally = bench("amqtt", 3, [], rounds=len(OPERATOR), seed=6, watchdog_s=1.0)
    assert len(tally.broken) > 0.9 * tally.count


def rows(*targets: float) -> list[Row]:
    return [Row(1000 + EVERY_ROUND_MS * index, (target, 0.0)) for index, target in enumerate(targets)]


def test_the_judge_measures_to_the_first_row_of_rest() -> None:
    moving = [0.01 * index for index in range(31)]
    verdict = judge(rows(*moving, *[0.4] * 40), cut_ms=1100, since_ms=1090)
    assert verdict.in_motion
    assert (verdict.rest_ms, verdict.cut_ms, verdict.starved_ms) == (220, 210, 0)
    assert verdict.met_limit


@pytest.mark.parametrize(
    "targets",
    [
        [0.01 * index for index in range(100)],
        [*(0.01 * index for index in range(60)), *[0.6] * 40],
        [*(0.01 * index for index in range(21)), *[0.3] * 30, 0.30001, *[0.3] * 20],
    ],
    ids=["never at rest", "too late", "moves again"],
)
def test_the_judge_reports(targets: list[float]) -> None:
    assert not judge(rows(*targets), cut_ms=1100, since_ms=1100).met_limit


def test_a_starved_control_loop_differs_from_a_late_one() -> None:
    moving = [0.01 * index for index in range(15)]
    verdict = judge(
        rows(*moving, *[0.14] * 5, *(0.14 + each for each in moving), *[0.28] * 40), cut_ms=1100, since_ms=1100
    )
    assert (verdict.rest_ms, verdict.starved_ms) == (240, 60)


def test_a_released_slider_is_not_motion() -> None:
    settled = [0.01 * index for index in range(12)]
    verdict = judge(rows(*settled, *[0.11] * 40, 0.5), cut_ms=1100, since_ms=1100)
    assert verdict.moved_again
    assert not verdict.in_motion
    assert not judge(rows(*settled, *[0.11] * 40, 0.5), cut_ms=1100, since_ms=1100, watched=False).met_limit


def test_a_reversal_is_not_rest() -> None:
    up = [0.01 * index for index in range(15)]
    verdict = judge(rows(*up, up[-1], *reversed(up), *[0.0] * 40), cut_ms=1100, since_ms=1100)
    assert verdict.rest_ms == 200
