"""Detectors report early, stay silent on healthy data, and match ``river``."""

import json
import math
import random
from collections.abc import Iterable
from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st
from river import drift, stats

from function_app.domain.health.detectors import (
    ABSENCE_MS,
    CHANGE,
    GAP_MS,
    LEVEL,
    OUTLIER,
    TREND,
    DetectorState,
    Limits,
    Trend,
    trend,
    update,
)
from function_app.domain.health.estimators import (
    MEMORY,
    WARM_UP,
    Baseline,
    PageHinkley,
    Streak,
    learn,
    page_hinkley,
    theil_sen,
)
from tests.harness.agent.motor_temperature import REST_C, daily, failing, windows, working

JOINT = Limits(warning_high=70.0, high=80.0)
NO_LIMITS = Limits()
values = st.floats(min_value=-1e6, max_value=1e6, allow_nan=False)


def run(
    samples: Iterable[tuple[int, float]], limits: Limits = JOINT, watch: DetectorState | None = None
) -> tuple[DetectorState, list[tuple[int, tuple[str, ...]]]]:
    """The final detector state, and each change of its findings."""
    watch = watch or DetectorState()
    found: list[tuple[int, tuple[str, ...]]] = []
    for at_ms, value in samples:
        before = watch.findings
        watch = update(watch, limits, at_ms, value)
        if watch.findings != before:
            found.append((at_ms, watch.findings))
    return watch, found


def steady(level: float, count: int, *, start_ms: int = 1_700_000_000_000, noise: float = 0.0, seed: int = 0):
    chance = random.Random(seed)  # noqa: S311 (repeatable noise)
    return [(start_ms + number * 10_000, level + chance.gauss(0, noise)) for number in range(count)]


class TestFaults:
    """Faults are reported before damage."""

    @pytest.mark.parametrize("seed", range(3))
    @pytest.mark.parametrize(("per_minute_c", "before_min"), [(0.2, 40), (0.5, 35), (1.0, 20), (2.0, 10)])
    def test_a_warming_joint_is_reported_early(self, per_minute_c: float, before_min: float, seed: int) -> None:
        truth = failing(daily(), from_s=4 * 3600, per_minute_c=per_minute_c)
        samples = list(windows(truth, hours=4 + 45 / per_minute_c / 60, seed=seed))
        over_ms = next(at_ms for at_ms, _ in samples if truth((at_ms - samples[0][0]) / 1000) >= 80.0)
        watch, found = run(samples)
        first_ms, kinds = found[0]
        assert first_ms > samples[0][0] + 4 * 3_600_000, "not before the fault"
        assert (over_ms - first_ms) / 60_000 >= before_min
        assert set(kinds) <= {LEVEL, TREND, OUTLIER}
        assert TREND in watch.findings
        assert watch.limit_in_s is not None

    def test_the_time_to_the_limit_is_accurate(self) -> None:
        truth = failing(lambda _: REST_C, from_s=0, per_minute_c=0.5)
        samples = list(windows(truth, hours=1.0, seed=1))
        watch, _ = run(samples)
        left_s = (80.0 - truth((samples[-1][0] - samples[0][0]) / 1000)) / (0.5 / 60)
        assert watch.limit_in_s == pytest.approx(left_s, rel=0.1)
        assert watch.slope_per_s == pytest.approx(0.5 / 60, rel=0.1)

    def test_a_value_falling_to_a_lower_limit_is_a_trend(self) -> None:
        battery = Limits(warning_low=20.5, low=20.0, horizon_s=1_800)
        falling = [(at_ms, 27.0 - 0.05 * place / 6) for place, (at_ms, _) in enumerate(steady(0, 1_200))]
        watch, found = run(falling, battery)
        assert found[0][1] == (TREND,)
        assert watch.findings[:2] == (LEVEL, TREND)

    def test_a_step_is_an_outlier_until_the_value_returns(self) -> None:
        samples = steady(35.0, 200, noise=0.3)
        step = steady(60.0, 12, start_ms=samples[-1][0] + 10_000, noise=0.3)
        back = steady(35.0, 12, start_ms=step[-1][0] + 10_000, noise=0.3)
        watch, found = run(samples + step, Limits(high=80.0, kinds=(OUTLIER,)))
        assert found == [(step[2][0], (OUTLIER,))]
        assert run(back, JOINT, watch)[0].findings == ()

    def test_a_lasting_shift_without_limits_is_a_change_and_then_the_new_baseline(self) -> None:
        only = Limits(kinds=(CHANGE,))
        samples = steady(10.0, 400, noise=0.1) + steady(
            11.5, 30 + 2 * MEMORY, start_ms=1_700_004_000_000, noise=0.1, seed=1
        )
        watch, found = run(samples, only)
        assert found[0][0] - samples[400][0] <= 300_000
        assert found[0][1] == (CHANGE,)
        assert watch.findings == ()

    def test_a_level_starts_after_20_s_and_ends_after_a_minute_inside_the_hysteresis(self) -> None:
        watch, found = run(steady(75.0, 2))
        assert found == [(1_700_000_010_000, (LEVEL,))]
        assert not watch.breach.on
        watch, _ = run(steady(85.0, 2, start_ms=watch.seen_ms + 10_000), watch=watch)
        assert watch.breach.on
        at_edge, _ = run(steady(69.5, 20, start_ms=watch.seen_ms + 10_000), Limits(warning_high=70, high=80), watch)
        assert at_edge.findings == (LEVEL,), "inside the limit but not inside the hysteresis"
        cool, _ = run(steady(60.0, 6, start_ms=watch.seen_ms + 10_000), Limits(warning_high=70, high=80), watch)
        assert LEVEL not in cool.findings


class TestHealthyData:
    """Healthy data are not reported."""

    @pytest.mark.parametrize("hours", [48, pytest.param(240, marks=pytest.mark.long)])
    @pytest.mark.parametrize(("rise_c", "settle_s"), [(0.0, 600.0), (5.0, 600.0), (10.0, 800.0), (15.0, 900.0)])
    def test_a_healthy_joint_raises_no_fault_for_days(self, rise_c: float, settle_s: float, hours: int) -> None:
        truth = working(rise_c, settle_s, seed=101, days=hours // 24)
        assert run(windows(truth, hours=hours, seed=1))[1] == []

    @pytest.mark.parametrize("noise", [0.01, 1.0, 50.0])
    def test_noise_of_any_size_is_not_reported(self, noise: float) -> None:
        assert run(steady(100.0, 8_640, noise=noise), NO_LIMITS)[1] == []

    @pytest.mark.parametrize("level", [0.0, 35.0, -1e12, 1e12, 1e300, 5e-324])
    def test_a_constant_and_its_first_step_raise_no_fault(self, level: float) -> None:
        samples = steady(level, 500) + steady(level / 2 + 1, 500, start_ms=1_700_005_000_000)
        watch, found = run(samples, NO_LIMITS)
        assert found == []
        json.dumps(asdict(watch), allow_nan=False)

    def test_a_stuck_sensor_that_recovers_raises_no_fault(self) -> None:
        samples = steady(35.0, 500, noise=0.3)
        stuck = steady(samples[-1][1], 10_000, start_ms=samples[-1][0] + 10_000)
        back = steady(35.0, 500, start_ms=stuck[-1][0] + 10_000, noise=0.3, seed=1)
        assert run(samples + stuck + back, NO_LIMITS)[1] == []

    @pytest.mark.parametrize(
        ("before_c", "gap_ms", "after_c"), [(55.0, ABSENCE_MS, 20.0), (35.0, GAP_MS, 48.0)], ids=["off", "gap"]
    )
    def test_a_step_over_a_gap_raises_no_fault(self, before_c: float, gap_ms: int, after_c: float) -> None:
        samples = steady(before_c, 120, noise=0.1)
        later = steady(after_c, 500, start_ms=samples[-1][0] + gap_ms + 10_000, noise=0.1, seed=1)
        assert run(samples + later)[1] == []

    def test_late_and_duplicate_windows_have_no_effect(self) -> None:
        samples = steady(35.0, 100, noise=0.3)
        watch, _ = run(samples)
        for at_ms, _ in samples[-3:]:
            assert update(watch, JOINT, at_ms, 500.0) is watch

    @given(
        st.lists(st.tuples(st.integers(1, 3_600_000), st.floats(allow_nan=False, allow_infinity=False)), max_size=80),
        st.sampled_from(
            [NO_LIMITS, JOINT, Limits(low=-1e300, high=1e300), Limits(low=5.0, high=5.0), Limits(change=1.0)]
        ),
    )
    def test_the_state_stays_small_and_finite(self, gaps: list[tuple[int, float]], limits: Limits) -> None:
        watch, at_ms = DetectorState(), 1
        for gap_ms, value in gaps:
            at_ms += gap_ms
            watch = update(watch, limits, at_ms, value)
        assert len(json.dumps(asdict(watch), allow_nan=False)) < 2_000


class TestAgainstRiver:
    """Comparison with the implementations of river."""

    @pytest.mark.parametrize(("delta", "threshold"), [(0.005, 50.0), (0.5, 15.0), (2.0, 60.0)])
    @pytest.mark.parametrize("seed", range(4))
    def test_page_hinkley_detects_the_same_changes(self, delta: float, threshold: float, seed: int) -> None:
        chance = random.Random(seed)  # noqa: S311 (repeatable data)
        river = drift.PageHinkley(min_instances=30, delta=delta, threshold=threshold, alpha=1.0)
        own, changes, river_changes = PageHinkley(), [], []
        for number in range(4_000):
            value = chance.gauss(10 + 5 * (number // 700 % 2), 1)
            own, changed = page_hinkley(own, value, delta=delta, threshold=threshold)
            river.update(value)
            if changed:
                changes.append(number)
                own = PageHinkley()
            if river.drift_detected:
                river_changes.append(number)
        assert changes == river_changes
        assert len(changes) >= 5

    @given(st.lists(values, min_size=1, max_size=MEMORY))
    def test_the_baseline_starts_as_the_mean(self, data: list[float]) -> None:
        mean, baseline = stats.Mean(), Baseline()
        for value in data:
            mean.update(value)
            # Nothing is clipped while the scale is large.
            baseline = learn(baseline, value, scale=1e9, repeated=False)
        assert baseline.mean == pytest.approx(mean.get(), abs=1e-6, rel=1e-9)

    def test_older_values_decay_exponentially(self) -> None:
        chance = random.Random(5)  # noqa: S311 (repeatable data)
        baseline, variance = Baseline(), stats.Var()
        for _ in range(MEMORY):
            value = chance.gauss(0, 2)
            variance.update(value)
            baseline = learn(baseline, value, scale=1e9, repeated=False)
        assert baseline.noise == pytest.approx(math.sqrt(variance.get()), rel=0.15)
        mean = stats.EWMean(fading_factor=1 / MEMORY)
        mean.update(baseline.mean)
        for _ in range(2_000):
            value = chance.gauss(3, 1)
            mean.update(value)
            baseline = learn(baseline, value, scale=1e9, repeated=False)
        assert baseline.mean == pytest.approx(mean.get(), rel=1e-9)


def test_the_baseline_tolerates_two_percent_outliers() -> None:
    samples = steady(35.0, 1_000, noise=0.3)
    disturbed = [(at_ms, 1e6 if place % 50 == 49 else value) for place, (at_ms, value) in enumerate(samples)]
    initial, _ = run(samples[:WARM_UP])
    watch, _ = run(disturbed[WARM_UP:], NO_LIMITS, initial)
    assert watch.baseline.mean == pytest.approx(35.0, abs=0.5)


def test_theil_sen_tolerates_a_quarter_of_outliers() -> None:
    line = [3.0 + 0.5 * place for place in range(12)]
    line[2], line[5], line[9] = 1e6, -1e6, 40.0
    slope = theil_sen(line, 60.0)
    assert slope.per_s == pytest.approx(0.5 / 60, rel=0.05)
    assert slope.end == pytest.approx(8.5, rel=0.05)


def test_a_streak_changes_after_its_length_in_both_directions() -> None:
    streak = Streak()
    states = []
    for bad in (True, True, False, True, True, True, False, False, True, False, False, False):
        streak = streak.step(bad=bad, good=not bad, after=3, until=3)
        states.append(streak.on)
    assert states == [False] * 5 + [True] * 6 + [False]
    assert Streak(on=True, length=2).step(bad=False, good=False, after=1, until=3) == Streak(on=True)


def test_the_distance_to_the_nearest_limit() -> None:
    assert Limits(low=0, high=10).room(2) == 2
    assert Limits(warning_high=8).room(2) == 6
    assert Limits(high=8).room(20) == 0
    assert NO_LIMITS.room(1) is None


def trend_of(minutes: list[float]) -> Trend:
    result = trend(minutes, JOINT)
    assert result is not None
    return result


class TestTrend:
    """Extrapolation of the last minutes."""

    def test_a_value_that_settles_below_the_limit_has_no_time_to_it(self) -> None:
        settling = trend_of([35 + 25 * -math.expm1(-number / 15) for number in range(20)])
        assert settling.per_s > 0
        assert settling.limit_in_s is None

    def test_the_time_to_the_limit_of_a_slowing_rise(self) -> None:
        slowing = trend_of([35 + 60 * -math.expm1(-number / 30) for number in range(20)])
        assert slowing.limit_in_s == pytest.approx(60 * (-30 * math.log(1 - 45 / 60) - 19), rel=0.1)

    def test_only_a_lasting_trend_is_proven(self) -> None:
        recent = trend_of([34.5 + 0.05 * number for number in range(10)] + [36.0 + number for number in range(10)])
        lasting = trend_of([35.0 + number for number in range(20)])
        assert recent.limit_in_s == pytest.approx(35 * 60)
        assert (recent.proven, lasting.proven) == (False, True)

    def test_too_few_minutes_and_noise_reach_no_limit(self) -> None:
        assert trend([35.0] * 9, JOINT) is None
        assert trend_of([35.0, 35.4, 34.8, 35.1, 35.3, 34.9, 35.2, 35.0, 35.3, 35.1]).limit_in_s is None
