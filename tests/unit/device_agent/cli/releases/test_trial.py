"""The trial of a release in the agent: it passes only with working threads, and with a link if there was one."""

import os
import signal
import time
from pathlib import Path

import pytest

from device_agent.cli.releases import trial as module
from device_agent.cli.releases.trial import FAILED, HEALTHY_S, PASSED, Trial


def trial(folder: Path, *, needs_link: bool = True, timeout_s: float = 60.0) -> Trial:
    return Trial(folder, "t1", needs_link=needs_link, timeout_s=timeout_s)


def result(folder: Path) -> str:
    file = folder / "release-trial"
    return file.read_text().strip() if file.exists() else ""


def test_it_passes_after_healthy_seconds_with_the_link(tmp_path: Path) -> None:
    tested = trial(tmp_path)
    assert not tested.check(healthy=True, linked=False, now_s=100.0)
    assert not tested.check(healthy=True, linked=True, now_s=101.0)
    assert not tested.check(healthy=True, linked=True, now_s=101.0 + HEALTHY_S - 0.1)
    assert result(tmp_path) == ""
    assert tested.check(healthy=True, linked=True, now_s=101.0 + HEALTHY_S)
    assert result(tmp_path) == "t1 passed"
    assert not tested.check(healthy=True, linked=True, now_s=200.0), "it passes once"
    assert not tested.finish(FAILED, "too late")
    assert result(tmp_path) == "t1 passed"


@pytest.mark.parametrize(("healthy", "linked"), [(False, True), (True, False)])
def test_a_failure_restarts_the_healthy_time(tmp_path: Path, healthy: bool, linked: bool) -> None:
    tested = trial(tmp_path)
    tested.check(healthy=True, linked=True, now_s=100.0)
    tested.check(healthy=healthy, linked=linked, now_s=104.0)
    assert not tested.check(healthy=True, linked=True, now_s=106.0)
    assert not tested.check(healthy=True, linked=True, now_s=110.0)
    assert tested.check(healthy=True, linked=True, now_s=111.0)


def test_without_a_former_link_none_is_needed(tmp_path: Path) -> None:
    tested = trial(tmp_path, needs_link=False)
    tested.check(healthy=True, linked=False, now_s=100.0)
    assert tested.check(healthy=True, linked=False, now_s=100.0 + HEALTHY_S)


@pytest.mark.parametrize(
    ("checks", "reason"),
    [
        ((), "it did not start its devices"),
        (((False, True),), "its threads fail"),
        (((True, False),), "it has no link to the cloud, as the release before had"),
    ],
)
def test_at_the_time_limit_it_fails_with_the_reason_and_ends_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, checks: tuple[tuple[bool, bool], ...], reason: str
) -> None:
    ended: list[object] = []
    monkeypatch.setattr(os, "kill", lambda pid, number: ended.append((pid, number)))
    monkeypatch.setattr(os, "_exit", ended.append)
    monkeypatch.setattr(module, "_EXIT_S", 0.0)
    tested = trial(tmp_path, timeout_s=0.05)
    for healthy, linked in checks:
        tested.check(healthy=healthy, linked=linked, now_s=1.0)
    tested.start()
    deadline_s = time.monotonic() + 60
    while len(ended) < 2 and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert ended == [(os.getpid(), signal.SIGTERM), module.EXIT_FAILED]
    assert result(tmp_path) == f"t1 failed {reason} within 0.05 s"


def test_a_passed_release_is_not_ended_at_the_time_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("ended"))
    tested = trial(tmp_path)
    assert tested.finish(PASSED)
    tested._expire()
    assert result(tmp_path) == "t1 passed"


@pytest.mark.parametrize("announced", ["", "t1", "t1 1 x", "t1 1 60 more"])
def test_without_a_complete_announcement_there_is_no_trial(tmp_path: Path, announced: str) -> None:
    assert Trial.of(tmp_path, {"TELESCOPE_TRIAL": announced}) is None


def test_the_announcement_of_the_launcher_is_understood(tmp_path: Path) -> None:
    announced = Trial.of(tmp_path, {"TELESCOPE_TRIAL": "t7 0 60"})
    assert announced is not None
    announced.check(healthy=True, linked=False, now_s=1.0)
    assert announced.check(healthy=True, linked=False, now_s=1.0 + HEALTHY_S)
    assert result(tmp_path) == "t7 passed"
