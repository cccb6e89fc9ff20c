"""What the soak makes of its samples, and that it finds the processes whose samples they are."""

import os
import subprocess
import sys
import time

import pytest

from benchmarks.soak.processes import CHILDREN, STARTER, TOGETHER, ProcessWatcher, Sample, look
from benchmarks.soak.trends import after_warm_up, drawn_together, theil_sen


def sample(at_s: float, *, mb: float = 100.0, descriptors: int = 20, part: str = "agent") -> Sample:
    return Sample(
        at_s=at_s, part=part, processes=1, rss_mb=mb + 50, pss_mb=mb, own_mb=mb, descriptors=descriptors, threads=3
    )


def test_the_slope_ignores_a_fifth_of_outliers() -> None:
    at_s = [60.0 * minute for minute in range(50)]
    values = [100 + minute / 60 + (30 if minute % 5 == 0 else 0) for minute in range(50)]
    found = theil_sen(at_s, values)
    assert found.percent_per_h == pytest.approx(1.0, rel=0.05)
    assert found.low <= found.percent_per_h <= found.high


def test_noise_alone_is_no_slope() -> None:
    found = theil_sen(
        [60.0 * minute for minute in range(50)], [100 + (minute * 7919 % 13) / 10 for minute in range(50)]
    )
    assert found.low <= 0 <= found.high


def test_two_points_are_no_slope() -> None:
    with pytest.raises(ValueError, match="too few"):
        theil_sen([0.0, 1.0], [1.0, 2.0])


def test_long_series_are_drawn_together_to_medians() -> None:
    times, values = drawn_together([float(each) for each in range(600)], [1.0] * 599 + [1000.0])
    assert len(times) == len(values) == 60
    assert max(values) == 1.0


def test_warming_up_does_not_count_and_a_leak_does() -> None:
    leaking = [sample(float(at), descriptors=20 + at // 60) for at in range(0, 3600, 5)]
    still = [sample(float(at), part="broker", mb=10 if at < 600 else 30) for at in range(0, 3600, 5)]
    found = {each.part: each for each in after_warm_up([*leaking, *still], 600)}
    assert found["agent"].more_descriptors > 30
    assert (found["broker"].more_descriptors, found["broker"].own.percent_per_h) == (0, 0)


def test_all_parts_are_also_looked_at_together_but_for_those_that_come_and_go() -> None:
    series = {"agent": 100.0, "broker": 20.0, CHILDREN: 50.0}
    samples = [sample(float(at), part=part, mb=mb) for at in range(0, 600, 5) for part, mb in series.items()]
    samples += [sample(float(at), part="worker", mb=30 + at / 60) for at in range(0, 600, 5)]
    found = {each.part: each for each in after_warm_up(samples, 0)}
    assert found[TOGETHER].own_mb == pytest.approx(155, abs=1)
    assert found[TOGETHER].own.percent_per_h == pytest.approx(60 / 155 * 100, rel=0.02)


def test_a_process_and_those_below_it_are_looked_at() -> None:
    program = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'input()'])"
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE) as process:
        deadline_s = time.monotonic() + 60
        while not (found := list(look(process.pid, 1.0))) or found[0].processes < 2:
            assert time.monotonic() < deadline_s
        assert [each.part for each in found] == [STARTER]
        assert found[0].own_mb > 1
        assert found[0].rss_mb >= found[0].pss_mb >= found[0].own_mb
        assert found[0].descriptors > 3


def test_samples_are_in_the_file_before_the_run_ends(tmp_path) -> None:
    file = tmp_path / "new" / "soak.csv"
    with ProcessWatcher(os.getpid(), every_s=0.01, file=file) as watch:
        deadline_s = time.monotonic() + 60
        while len(file.read_text().splitlines() if file.exists() else ()) < 3:
            assert time.monotonic() < deadline_s
    head, first, *_ = file.read_text().splitlines()
    assert head.startswith("at_s,part,processes,rss_mb")
    assert first.split(",")[1] == watch.samples[0].part == STARTER
