"""Supervision by the program: the watchdog of systemd is notified only while essential threads run."""

import os
import subprocess
import sys
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from device_agent.cli import run, systemd


class Agent:
    """An agent whose supervisor finds what the test says."""

    def __init__(self, *results: str, healthy: bool = True) -> None:
        self.results = list(results)
        self.supervisor: Any = SimpleNamespace(check=lambda: self.results.pop(0), healthy=healthy)

    @property
    def outdated(self) -> bool:
        return not self.results


@pytest.fixture
def notified(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Notifications of the watchdog."""
    notified: list[str] = []
    monkeypatch.setattr(systemd, "notify_watchdog", lambda: notified.append("watchdog"))
    return notified


def supervise(agent: Any) -> int | None:
    return run._supervise(agent, threading.Event())


def test_a_healthy_agent_notifies_the_watchdog_until_it_is_unpaired(notified: list[str]) -> None:
    assert supervise(Agent("", "")) is None
    assert notified


def test_an_agent_with_a_failed_essential_thread_does_not(notified: list[str]) -> None:
    assert supervise(Agent("", "", healthy=False)) is None
    assert notified == []


def test_a_signal_ends_it_in_an_orderly_way() -> None:
    stop = threading.Event()
    stop.set()
    agent: Any = Agent("")
    assert run._supervise(agent, stop) == 0


def test_a_failure_ends_the_process_even_if_its_orderly_end_hangs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    codes: list[int] = []
    exited = threading.Event()

    def record(code: int) -> None:
        codes.append(code)
        exited.set()

    monkeypatch.setattr(os, "_exit", record)
    monkeypatch.setattr(run, "_STOP_S", 0.0)
    assert supervise(Agent("the control loop has ended", healthy=False)) == run.EXIT_FAILED
    assert exited.wait(60)
    assert codes == [run.EXIT_FAILED]
    assert "the control loop has ended" in capsys.readouterr().err


_ALLOCATE = """
import ctypes, threading
from device_agent.cli import run

{configure}
library = ctypes.CDLL(None)
barrier = threading.Barrier(6)

def allocate():
    library.malloc(1000)
    barrier.wait()

threads = [threading.Thread(target=allocate) for _ in range(6)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
library.malloc_stats()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has the GNU C library")
@pytest.mark.parametrize(("configure", "few"), [("run._configure_allocator()", True), ("", False)])
def test_threads_share_two_heaps(configure: str, few: bool) -> None:
    program = [sys.executable, "-c", _ALLOCATE.format(configure=configure)]
    shown = subprocess.run(program, capture_output=True, text=True, check=True).stderr
    assert (shown.count("Arena ") <= 2) is few


_ALLOCATE_LARGE = """
import ctypes, re
from device_agent.cli import run

{configure}
library = ctypes.CDLL(None)
library.malloc.argtypes, library.malloc.restype = [ctypes.c_size_t], ctypes.c_void_p
library.free.argtypes = [ctypes.c_void_p]
library.free(library.malloc(4_000_000))
address = library.malloc(1_000_000)
with open("/proc/self/maps") as maps:
    first, last = re.search(r"^(\\w+)-(\\w+) .*\\[heap\\]$", maps.read(), re.MULTILINE).groups()
print(int(first, 16) <= address < int(last, 16))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has the GNU C library")
@pytest.mark.parametrize(("configure", "in_heap"), [("run._configure_allocator()", False), ("", True)])
def test_large_blocks_are_not_in_a_heap(configure: str, in_heap: bool) -> None:
    program = [sys.executable, "-c", _ALLOCATE_LARGE.format(configure=configure)]
    shown = subprocess.run(program, capture_output=True, text=True, check=True).stdout
    assert shown == f"{in_heap}\n"
