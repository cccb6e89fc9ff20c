"""Samples as a set by time, in windows and buckets."""

import itertools
import json
import math
import random
import tomllib
from array import array
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import (
    DAY,
    FINEST,
    LEVELS,
    MAX_VALUES,
    WINDOW_MS,
    Bucket,
    RetentionPolicy,
    Samples,
)
from function_app.ports.tables import MAX_DATA_BYTES
from tests.harness.paths import ROOT

VALUES = st.floats(-1e300, 1e300)
ROWS = st.lists(
    st.tuples(st.integers(0, 40_000), st.dictionaries(st.sampled_from("abc"), VALUES, min_size=1)), max_size=60
)
NOW_MS = 1_800_000_000_000
Rows = list[tuple[int, dict[str, float]]]


def rows_of(samples: Samples) -> dict[int, dict[str, float]]:
    result: dict[int, dict[str, float]] = {}
    for index, at_ms in enumerate(samples.at_ms):
        values = {name: column[index] for name, column in samples.columns.items()}
        result[at_ms] = {name: value for name, value in values.items() if not math.isnan(value)}
    return result


def truth(rows: Rows) -> dict[int, dict[str, float]]:
    first: dict[int, dict[str, float]] = {}
    for at_ms, values in rows:
        first.setdefault(at_ms, values)
    return first


@given(ROWS)
def test_the_first_sample_of_a_time_counts(rows: Rows) -> None:
    samples = series.from_rows(rows)
    assert rows_of(samples) == truth(rows)
    assert list(samples.at_ms) == sorted(set(samples.at_ms))


@given(ROWS)
def test_unpacking_reverses_packing(rows: Rows) -> None:
    samples = series.from_rows(rows)
    packed = json.loads(json.dumps(series.pack(samples)))
    assert rows_of(series.unpack(packed)) == rows_of(samples)


@given(ROWS, ROWS)
def test_samples_are_a_set_by_time(one: Rows, other: Rows) -> None:
    stored = series.from_rows(one)
    new = series.new_samples(series.from_rows(other), stored)
    assert rows_of(series.merge(stored, new)) == truth(one + other)
    assert len(series.new_samples(series.from_rows(other), series.merge(stored, new))) == 0


@given(ROWS)
def test_windows_contain_every_sample_once(rows: Rows) -> None:
    samples = series.from_rows(rows)
    result: dict[int, dict[str, float]] = {}
    for start_ms, window in samples.windows():
        assert start_ms % WINDOW_MS == 0
        assert all(start_ms <= at_ms < start_ms + WINDOW_MS for at_ms in window.at_ms)
        result |= rows_of(window)
    assert result == rows_of(samples)


@given(ROWS, st.randoms(use_true_random=False))
def test_a_bucket_does_not_depend_on_the_sample_order(rows: Rows, chance: random.Random) -> None:
    samples = series.from_rows(rows)
    parts = [samples.part(index, index + 1) for index in range(len(samples))]
    chance.shuffle(parts)
    bucket = Bucket()
    for part in parts:
        bucket.add(series.bucket(json.loads(json.dumps(series.summarize(part).data()))))
    assert bucket.count == len(samples)
    for name in samples.columns:
        values = [(at_ms, each[name]) for at_ms, each in sorted(truth(rows).items()) if name in each]
        summary = bucket.fields[name]
        numbers = [value for _, value in values]
        assert (summary.samples, summary.low, summary.high) == (len(values), min(numbers), max(numbers))
        assert (summary.last_ms, summary.last) == values[-1]
        scale = max(map(abs, numbers))
        assert summary.total == pytest.approx(math.fsum(numbers), rel=1e-9, abs=1e-9 * scale)
        assert series.summarize(samples).fields[name][:1] + summary[2:] == summary[:1] + summary[2:]


@pytest.mark.parametrize("fields", [1, 2, 18, 128, 256])
def test_a_full_incompressible_window_fits_into_a_row(fields: int) -> None:
    chance = random.Random(5)  # noqa: S311 (the same noise each time)
    times = sorted(chance.sample(range(WINDOW_MS), 9_000))
    names = [f"{'x' * 76}{number:03d}" for number in range(fields)]
    noise = {name: array("d", [chance.uniform(-1e9, 1e9) for _ in times]) for name in names}
    window = series.fit_window(Samples(array("q", [NOW_MS + at_ms for at_ms in times]), noise), Samples())
    most = MAX_VALUES // (fields + 1)
    assert min(9_000, most) - 1 <= len(window) <= min(9_000, most)
    assert len(json.dumps(series.pack(window))) < MAX_DATA_BYTES
    assert len(window) + len(series.fit_window(window, Samples(window.at_ms, window.columns))) <= most


def test_a_window_in_parts_is_stored_like_a_whole_one_and_covers_all_of_it() -> None:
    """It contained only its first eight seconds if a robot with 33 joints sent twenty times a second."""
    rows = [(NOW_MS + at_ms, {f"f{number}": float(at_ms) for number in range(99)}) for at_ms in range(0, WINDOW_MS, 20)]
    whole = series.fit_window(series.from_rows(rows), Samples())
    stored = Samples()
    for begin in range(0, len(rows), 7):
        for _ in range(2):  # each delivered twice
            new = series.new_samples(series.from_rows(rows[begin : begin + 7]), stored)
            stored = series.merge(stored, series.fit_window(new, stored))
    assert stored == whole
    gaps = [after - before for before, after in itertools.pairwise(stored.at_ms)]
    assert max(gaps) <= 60
    assert WINDOW_MS - stored.at_ms[-1] % WINDOW_MS <= 60


def test_new_fields_do_not_make_a_window_too_large() -> None:
    stored = series.from_rows([(NOW_MS + at_ms, {"a": 1.0, "b": 1.0}) for at_ms in range(0, WINDOW_MS, 2)])
    wide = series.from_rows([(NOW_MS + at_ms, {f"f{number}": 1.0 for number in range(250)}) for at_ms in (1, 9_999)])
    assert not series.fit_window(wide, stored)


@pytest.mark.parametrize("path", sorted((ROOT / "robots").glob("*/robot.toml")), ids=lambda path: path.parent.name)
def test_the_joints_of_each_robot_are_stored_at_their_rate_at_rest(path: Path) -> None:
    robot = tomllib.loads(path.read_text(encoding="utf-8"))
    (rate_hz,) = [stream["rate_hz"] for stream in robot["streams"] if stream["name"] == "joints"]
    fields = [f"{quantity}.{number}" for quantity in ("p", "v", "e") for number in range(len(robot["joints"]))]
    times = [round(number * 1000 / rate_hz) for number in range(round(rate_hz * WINDOW_MS / 1000))]
    samples = series.from_rows([(NOW_MS + at_ms, dict.fromkeys(fields, 1.0)) for at_ms in times])
    assert len(series.fit_window(samples, Samples())) == len(times)


def test_a_bucket_of_all_fields_fits_into_a_row() -> None:
    names = [f"{'x' * 77}{number:03d}" for number in range(series.MAX_FIELDS)]
    value = -1.2345678901234567e300
    bucket = series.summarize(series.from_rows([(NOW_MS + n, dict.fromkeys(names, value)) for n in range(3)]))
    assert len(json.dumps(bucket.data())) < MAX_DATA_BYTES


def test_sums_of_the_largest_values_stay_finite() -> None:
    bucket = Bucket()
    for day in range(2_000):
        bucket.add(series.summarize(series.from_rows([(day, {"a": series.MAX_MAGNITUDE})])))
    assert math.isfinite(bucket.fields["a"].total)


@pytest.mark.parametrize(
    ("hours", "points", "level"),
    [(1, 500, "10s"), (1, 300, "1min"), (24, 1000, "10min"), (24 * 30, 1000, "1h"), (24 * 30, 100, "1d")],
)
def test_the_finest_buckets_that_fit_are_chosen(hours: int, points: int, level: str) -> None:
    first_ms = NOW_MS - hours * 3_600_000
    assert series.finest_level(first_ms, NOW_MS, points=points, now_ms=NOW_MS, keep=RetentionPolicy()).name == level


def test_deleted_levels_are_not_chosen() -> None:
    first_ms = NOW_MS - 20 * DAY.span_ms
    last_ms = first_ms + 600_000
    assert series.finest_level(first_ms, last_ms, points=500, now_ms=first_ms, keep=RetentionPolicy()) == FINEST
    assert series.finest_level(first_ms, last_ms, points=500, now_ms=NOW_MS, keep=RetentionPolicy()).name == "1min"
    ancient_ms = NOW_MS - 3000 * DAY.span_ms
    assert (
        series.finest_level(ancient_ms, ancient_ms + 60_000, points=500, now_ms=NOW_MS, keep=RetentionPolicy()).name
        == "1h"
    )


def test_keys_of_a_level_sort_by_time_and_contain_their_start() -> None:
    starts = [0, 9_000, 10_000, NOW_MS]
    for level in LEVELS:
        keys = [series.key(level, start_ms) for start_ms in starts]
        assert keys == sorted(keys)
        assert [series.start_of(key) for key in keys] == starts
