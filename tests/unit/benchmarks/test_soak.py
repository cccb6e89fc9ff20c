"""The soak benchmark samples the product's processes and finds growth in the samples."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.soak.processes import CHILDREN, STARTER, TOTAL, ProcessWatcher, Sample, sample_parts
from benchmarks.soak.trends import after_warm_up, reduced_to_medians, theil_sen
from benchmarks.suites.soak import ended_by_signal, log_errors
from tests.harness.network.brokers import wait_until

MINUTES = range(50)
TIMES_S = [60.0 * minute for minute in MINUTES]


def sample(at_s: float, *, mb: float = 100.0, descriptors: int = 20, part: str = "agent", processes: int = 1) -> Sample:
    memory = {"rss_mb": mb + 50, "pss_mb": mb, "own_mb": mb}
    return Sample(at_s=at_s, part=part, processes=processes, descriptors=descriptors, threads=3, **memory)


def test_the_slope_ignores_outliers_and_noise() -> None:
    slope = theil_sen(TIMES_S, [100 + minute / 60 + (30 if minute % 5 == 0 else 0) for minute in MINUTES])
    assert slope.percent_per_h == pytest.approx(1.0, rel=0.05)
    assert slope.low <= slope.percent_per_h <= slope.high
    slope = theil_sen(TIMES_S, [100 + (minute * 7919 % 13) / 10 for minute in MINUTES])
    assert slope.low <= 0 <= slope.high
    with pytest.raises(ValueError, match="too few"):
        theil_sen([0.0, 1.0], [1.0, 2.0])


def test_long_series_are_reduced_to_medians() -> None:
    times, values = reduced_to_medians([float(each) for each in range(600)], [1.0] * 599 + [1000.0])
    assert len(times) == len(values) == 60
    assert max(values) == 1.0


def test_growth_counts_after_the_warm_up() -> None:
    leaking = [sample(float(at), descriptors=20 + at // 60) for at in range(0, 3600, 5)]
    warming = [sample(float(at), part="broker", mb=10 if at < 600 else 30) for at in range(0, 3600, 5)]
    trends = {each.part: each for each in after_warm_up([*leaking, *warming], 600)}
    assert trends["agent"].more_descriptors > 30
    assert (trends["broker"].more_descriptors, trends["broker"].own.percent_per_h) == (0, 0)


@pytest.mark.parametrize("leaked", [0, 1])
def test_descriptors_of_running_scripts_do_not_count_as_additional(leaked: int) -> None:
    samples = []
    for at in range(0, 3600, 5):
        children = 3 if at % 20 else 2 + at // 2000  # at the end no sample has the fewest children
        descriptors = 20 + 2 * children + (leaked if at > 1800 else 0)
        samples.append(sample(float(at), descriptors=descriptors))
        samples.append(sample(float(at), part=CHILDREN, processes=children))
    trends = {each.part: each for each in after_warm_up(samples, 0)}
    assert (trends["agent"].first_descriptors, trends["agent"].more_descriptors) == (26, leaked)


def test_parts_without_samples_at_the_most_frequent_load_count_with_all_of_theirs() -> None:
    samples = [sample(float(at)) for at in range(0, 3600, 5)]
    samples += [sample(float(at), part=CHILDREN, descriptors=5) for at in range(0, 3600, 60)]
    trends = {each.part: each for each in after_warm_up(samples, 0)}
    assert (trends[CHILDREN].first_descriptors, trends["agent"].first_descriptors) == (5, 20)


def test_permanent_parts_are_also_evaluated_in_total() -> None:
    series = {"agent": 100.0, "broker": 20.0, CHILDREN: 50.0}
    samples = [sample(float(at), part=part, mb=mb) for at in range(0, 600, 5) for part, mb in series.items()]
    samples += [sample(float(at), part="worker", mb=30 + at / 60) for at in range(0, 600, 5)]
    total = {each.part: each for each in after_warm_up(samples, 0)}[TOTAL]
    assert total.own_mb == pytest.approx(155, abs=1)
    assert total.own.percent_per_h == pytest.approx(60 / 155 * 100, rel=0.02)


def test_a_process_is_sampled_with_its_children() -> None:
    program = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'input()'])"
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE) as process:
        wait_until(lambda: [each.processes for each in sample_parts(process.pid, 1.0)] == [2], "the child")
        (sampled,) = sample_parts(process.pid, 1.0)
        assert sampled.part == STARTER
        assert sampled.rss_mb >= sampled.pss_mb >= sampled.own_mb > 1
        assert sampled.descriptors > 3


def test_samples_are_written_during_the_run(tmp_path: Path) -> None:
    file = tmp_path / "new" / "soak.csv"
    with ProcessWatcher(os.getpid(), every_s=0.01, file=file) as watcher:
        wait_until(lambda: file.exists() and len(file.read_text().splitlines()) >= 3, "two samples")
    head, first, *_ = file.read_text().splitlines()
    assert head.startswith("at_s,part,processes,rss_mb")
    assert first.split(",")[1] == watcher.samples[0].part == STARTER


def test_error_lines_of_the_programs_are_counted(tmp_path: Path) -> None:
    (tmp_path / "agent.log").write_text(
        "2026-11-24 10:00:00,000 INFO no ERROR here\n2026-11-24 10:00:01,000 ERROR failed [device=arm]\n"
        "Traceback (most recent call last):\n  File\nValueError: x\n"
    )
    (tmp_path / "broker.log").write_text("WARNING a\nERROR infra.broker: b\nready\n")
    assert log_errors(tmp_path) == {
        "agent: ERROR failed [device=arm]": 1,
        "agent: Traceback (most recent call last):": 1,
        "broker: ERROR infra.broker: b": 1,
    }


def test_a_signal_ends_a_run_with_its_report() -> None:
    before = signal.getsignal(signal.SIGINT)
    with ended_by_signal() as ended:
        os.kill(os.getpid(), signal.SIGINT)
        assert ended.wait(10)
    assert signal.getsignal(signal.SIGINT) is before
