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
NOTHING = Limits()
values = st.floats(min_value=-1e6, max_value=1e6, allow_nan=False)


def life(
    given: Iterable[tuple[int, float]], limits: Limits = JOINT, watch: DetectorState | None = None
) -> tuple[DetectorState, list[tuple[int, tuple[str, ...]]]]:
    """The watch at the end, and each change of what is found."""
    watch = watch or DetectorState()
    found: list[tuple[int, tuple[str, ...]]] = []
    for at_ms, value in given:
        before = watch.findings
        watch = update(watch, limits, at_ms, value)
        if watch.findings != before:
            found.append((at_ms, watch.findings))
    return watch, found


def steady(level: float, count: int, *, start_ms: int = 1_700_000_000_000, noise: float = 0.0, seed: int = 0):
    chance = random.Random(seed)  # noqa: S311 (repeatable noise)
    return [(start_ms + number * 10_000, level + chance.gauss(0, noise)) for number in range(count)]


class TestEarly:
    """Faults are reported before damage."""

    @pytest.mark.parametrize("seed", range(3))
    @pytest.mark.parametrize(("per_minute_c", "before_min"), [(0.2, 40), (0.5, 35), (1.0, 20), (2.0, 10)])
    def test_a_joint_that_warms_without_end_is_told_long_before_its_limit(
        self, per_minute_c: float, before_min: float, seed: int
    ) -> None:
        truth = failing(daily(), from_s=4 * 3600, per_minute_c=per_minute_c)
        given = list(windows(truth, hours=4 + 45 / per_minute_c / 60, seed=seed))
        over_ms = next(at_ms for at_ms, _ in given if truth((at_ms - given[0][0]) / 1000) >= 80.0)
        watch, found = life(given)
        first_ms, kinds = found[0]
        assert first_ms > given[0][0] + 4 * 3_600_000, "not before it began"
        assert (over_ms - first_ms) / 60_000 >= before_min
        assert set(kinds) <= {LEVEL, TREND, OUTLIER}
        assert TREND in watch.findings
        assert watch.limit_in_s is not None

    def test_the_time_to_the_limit_is_right(self) -> None:
        truth = failing(lambda _: REST_C, from_s=0, per_minute_c=0.5)
        given = list(windows(truth, hours=1.0, seed=1))
        watch, _ = life(given)
        left_s = (80.0 - truth((given[-1][0] - given[0][0]) / 1000)) / (0.5 / 60)
        assert watch.limit_in_s == pytest.approx(left_s, rel=0.1)
        assert watch.slope_per_s == pytest.approx(0.5 / 60, rel=0.1)

    def test_what_falls_to_a_lower_limit_is_told_as_well(self) -> None:
        battery = Limits(warning_low=20.5, low=20.0, horizon_s=1_800)
        falling = [(at_ms, 27.0 - 0.05 * place / 6) for place, (at_ms, _) in enumerate(steady(0, 1_200))]
        watch, found = life(falling, battery)
        assert found[0][1] == (TREND,)
        assert watch.findings[:2] == (LEVEL, TREND)

    def test_a_leap_is_an_outlier_within_a_minute_and_over_when_it_is_back(self) -> None:
        given = steady(35.0, 200, noise=0.3)
        leap = steady(60.0, 12, start_ms=given[-1][0] + 10_000, noise=0.3)
        back = steady(35.0, 12, start_ms=leap[-1][0] + 10_000, noise=0.3)
        watch, found = life(given + leap, Limits(high=80.0, kinds=(OUTLIER,)))
        assert found == [(leap[2][0], (OUTLIER,))]
        assert life(back, JOINT, watch)[0].findings == ()

    def test_a_lasting_shift_without_limits_is_a_change_and_becomes_the_new_normal(self) -> None:
        only = Limits(kinds=(CHANGE,))
        given = steady(10.0, 400, noise=0.1) + steady(
            11.5, 30 + 2 * MEMORY, start_ms=1_700_004_000_000, noise=0.1, seed=1
        )
        watch, found = life(given, only)
        assert found[0][0] - given[400][0] <= 300_000
        assert found[0][1] == (CHANGE,)
        assert watch.findings == ()

    def test_beyond_a_limit_for_twenty_seconds_is_enough_and_well_inside_for_a_minute_ends_it(self) -> None:
        watch, found = life(steady(75.0, 2))
        assert found == [(1_700_000_010_000, (LEVEL,))]
        assert not watch.breach.on
        watch, _ = life(steady(85.0, 2, start_ms=watch.seen_ms + 10_000), watch=watch)
        assert watch.breach.on
        at_edge, _ = life(steady(69.5, 20, start_ms=watch.seen_ms + 10_000), Limits(warning_high=70, high=80), watch)
        assert at_edge.findings == (LEVEL,), "a hair below the limit is not well"
        cool, _ = life(steady(60.0, 6, start_ms=watch.seen_ms + 10_000), Limits(warning_high=70, high=80), watch)
        assert LEVEL not in cool.findings


class TestSilent:
    """Healthy data are not reported."""

    @pytest.mark.parametrize("seed", range(2))
    @pytest.mark.parametrize(("rise_c", "settle_s"), [(0.0, 600.0), (5.0, 600.0), (10.0, 600.0), (15.0, 900.0)])
    def test_days_noise_and_work_of_a_healthy_joint_raise_nothing(
        self, rise_c: float, settle_s: float, seed: int
    ) -> None:
        truth = working(rise_c, settle_s, seed=seed, days=2)
        assert life(windows(truth, hours=48, seed=seed))[1] == []

    @pytest.mark.long
    @pytest.mark.parametrize("rise_c", [0.0, 5.0, 10.0, 15.0])
    def test_nor_in_forty_days(self, rise_c: float) -> None:
        truth = working(rise_c, 600 + 20 * rise_c, seed=101, days=10)
        assert life(windows(truth, hours=240, seed=1))[1] == []

    @pytest.mark.parametrize("noise", [0.01, 1.0, 50.0])
    def test_noise_of_any_size_is_not_reported(self, noise: float) -> None:
        assert life(steady(100.0, 8_640, noise=noise), NOTHING)[1] == []

    @pytest.mark.parametrize("level", [0.0, 35.0, -1e12, 1e12, 1e300, 5e-324])
    def test_a_constant_is_nothing_and_neither_is_its_first_step(self, level: float) -> None:
        given = steady(level, 500) + steady(level / 2 + 1, 500, start_ms=1_700_005_000_000)
        watch, found = life(given, NOTHING)
        assert found == []
        json.dumps(asdict(watch), allow_nan=False)

    def test_a_sensor_that_is_stuck_and_comes_back_is_nothing(self) -> None:
        given = steady(35.0, 500, noise=0.3)
        stuck = steady(given[-1][1], 10_000, start_ms=given[-1][0] + 10_000)
        back = steady(35.0, 500, start_ms=stuck[-1][0] + 10_000, noise=0.3, seed=1)
        assert life(given + stuck + back, NOTHING)[1] == []

    def test_a_robot_that_was_off_may_come_back_cold(self) -> None:
        given = steady(55.0, 500, noise=0.3)
        cold = steady(20.0, 500, start_ms=given[-1][0] + ABSENCE_MS + 10_000, noise=0.3, seed=1)
        assert life(given + cold)[1] == []

    def test_a_gap_is_no_trend(self) -> None:
        given = steady(35.0, 120, noise=0.1)
        later = steady(48.0, 120, start_ms=given[-1][0] + GAP_MS + 10_000, noise=0.1, seed=1)
        assert life(given + later)[1] == []

    def test_a_window_that_comes_late_or_twice_changes_nothing(self) -> None:
        given = steady(35.0, 100, noise=0.3)
        watch, _ = life(given)
        for at_ms, _ in given[-3:]:
            assert update(watch, JOINT, at_ms, 500.0) is watch

    @given(
        st.lists(st.tuples(st.integers(1, 3_600_000), st.floats(allow_nan=False, allow_infinity=False)), max_size=80),
        st.sampled_from(
            [NOTHING, JOINT, Limits(low=-1e300, high=1e300), Limits(low=5.0, high=5.0), Limits(change=1.0)]
        ),
    )
    def test_no_values_break_it_and_its_state_stays_small_and_finite(
        self, gaps: list[tuple[int, float]], limits: Limits
    ) -> None:
        watch, at_ms = DetectorState(), 1
        for gap_ms, value in gaps:
            at_ms += gap_ms
            watch = update(watch, limits, at_ms, value)
        assert len(json.dumps(asdict(watch), allow_nan=False)) < 2_000


class TestAgainstRiver:
    """Comparison with the implementations of river."""

    @pytest.mark.parametrize(("delta", "threshold"), [(0.005, 50.0), (0.5, 15.0), (2.0, 60.0)])
    @pytest.mark.parametrize("seed", range(4))
    def test_page_hinkley_tells_the_same_changes_at_the_same_values(
        self, delta: float, threshold: float, seed: int
    ) -> None:
        chance = random.Random(seed)  # noqa: S311 (repeatable data)
        data = [chance.gauss(10 + 5 * (number // 700 % 2), 1) for number in range(4_000)]
        theirs = drift.PageHinkley(min_instances=30, delta=delta, threshold=threshold, alpha=1.0)
        mine, told, theirs_told = PageHinkley(), [], []
        for number, value in enumerate(data):
            mine, changed = page_hinkley(mine, value, delta=delta, threshold=threshold)
            theirs.update(value)
            if changed:
                told.append(number)
                mine = PageHinkley()
            if theirs.drift_detected:
                theirs_told.append(number)
        assert told == theirs_told
        assert len(told) >= 5

    @given(st.lists(values, min_size=1, max_size=MEMORY))
    def test_the_baseline_begins_as_the_mean(self, data: list[float]) -> None:
        mean, known = stats.Mean(), Baseline()
        for value in data:
            mean.update(value)
            # Nothing is clipped while the scale is large.
            known = learn(known, value, scale=1e9, repeated=False)
        assert known.mean == pytest.approx(mean.get(), abs=1e-6, rel=1e-9)

    def test_then_it_forgets_exponentially(self) -> None:
        chance = random.Random(5)  # noqa: S311 (repeatable data)
        known = Baseline()
        for _ in range(MEMORY):
            known = learn(known, chance.gauss(0, 1), scale=1e9, repeated=False)
        theirs = stats.EWMean(fading_factor=1 / MEMORY)
        theirs.update(known.mean)
        for _ in range(2_000):
            value = chance.gauss(3, 1)
            theirs.update(value)
            known = learn(known, value, scale=1e9, repeated=False)
        assert known.mean == pytest.approx(theirs.get(), rel=1e-9)

    def test_its_noise_is_the_standard_deviation(self) -> None:
        chance = random.Random(6)  # noqa: S311 (repeatable data)
        theirs, known = stats.Var(), Baseline()
        for _ in range(MEMORY):
            value = chance.gauss(0, 2)
            theirs.update(value)
            known = learn(known, value, scale=1e9, repeated=False)
        assert known.noise == pytest.approx(math.sqrt(theirs.get()), rel=0.15)

    def test_on_a_healthy_life_of_a_week_rivers_page_hinkley_cries_and_this_does_not(self) -> None:
        """The figures in the architecture: the same shift and patience, river's usual forgetting."""
        truth = working(10.0, 600.0, seed=7, days=3)
        theirs = drift.PageHinkley(min_instances=30, delta=11.0, threshold=330.0)
        alarms = 0
        watch = DetectorState()
        for at_ms, value in windows(truth, hours=72, seed=7):
            theirs.update(value)
            alarms += theirs.drift_detected
            watch = update(watch, JOINT, at_ms, value)
            assert watch.findings == ()
        assert alarms > 0


def test_one_value_in_fifty_does_not_lead_the_baseline_astray() -> None:
    given = steady(35.0, 1_000, noise=0.3)
    spoilt = [(at_ms, 1e6 if place % 50 == 49 else value) for place, (at_ms, value) in enumerate(given)]
    calm, _ = life(given[:WARM_UP])
    watch, _ = life(spoilt[WARM_UP:], NOTHING, calm)
    assert watch.baseline.mean == pytest.approx(35.0, abs=0.5)


def test_theil_sen_does_not_see_a_quarter_of_wild_values() -> None:
    line = [3.0 + 0.5 * place for place in range(12)]
    line[2], line[5], line[9] = 1e6, -1e6, 40.0
    slope = theil_sen(line, 60.0)
    assert slope.per_s == pytest.approx(0.5 / 60, rel=0.05)
    assert slope.end == pytest.approx(8.5, rel=0.05)


def test_a_streak_needs_its_length_both_ways() -> None:
    streak = Streak()
    seen = []
    for bad in (True, True, False, True, True, True, False, False, True, False, False, False):
        streak = streak.step(bad=bad, good=not bad, after=3, until=3)
        seen.append(streak.on)
    assert seen == [False] * 5 + [True] * 6 + [False]
    assert Streak(on=True, length=2).step(bad=False, good=False, after=1, until=3) == Streak(on=True)


def test_the_room_to_the_nearest_limit() -> None:
    assert Limits(low=0, high=10).room(2) == 2
    assert Limits(warning_high=8).room(2) == 6
    assert Limits(high=8).room(20) == 0
    assert NOTHING.room(1) is None


class TestTrend:
    """Extrapolation of the last minutes."""

    def test_what_comes_to_rest_below_the_limit_never_meets_it(self) -> None:
        minutes = [35 + 25 * -math.expm1(-number / 15) for number in range(20)]
        found = trend(minutes, JOINT)
        assert found is not None
        assert found.per_s > 0
        assert found.limit_in_s is None

    def test_what_slows_down_beyond_the_limit_meets_it_when_it_does(self) -> None:
        minutes = [35 + 60 * -math.expm1(-number / 30) for number in range(20)]
        meets_s = 60 * (-30 * math.log(1 - 45 / 60) - 19)
        found = trend(minutes, JOINT)
        assert found is not None
        assert found.limit_in_s == pytest.approx(meets_s, rel=0.1)

    def test_only_what_has_lasted_is_proven(self) -> None:
        recent = trend(
            [34.5 + 0.05 * number for number in range(10)] + [35.0 + number for number in range(1, 11)], JOINT
        )
        lasting = trend([35.0 + number for number in range(20)], JOINT)
        assert recent is not None
        assert lasting is not None
        assert recent.limit_in_s == pytest.approx(35 * 60)
        assert (recent.proven, lasting.proven) == (False, True)

    def test_too_few_minutes_and_noise_lead_nowhere(self) -> None:
        assert trend([35.0] * 9, JOINT) is None
        noise = [35.0, 35.4, 34.8, 35.1, 35.3, 34.9, 35.2, 35.0, 35.3, 35.1]
        found = trend(noise, JOINT)
        assert found is not None
        assert found.limit_in_s is None
