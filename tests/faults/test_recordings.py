"""Killed processes and full disks: at most the last second of a recording is missing, and control is not affected."""

import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import GrantLease, State
from device_agent.protocol.events import EventKind
from device_agent.runtime.recording.folder import RecordingFolder, overview_of
from device_agent.runtime.recording.recorder import Recorder
from device_agent.runtime.recording.recorder_worker import RecorderWorker
from tests.harness.agent.device_harness import DeviceHarness, eventually, wait_for_state
from tests.harness.agent.recordings.segments import limits, live_sequences, sealed_messages
from tests.harness.paths import ROOT
from tests.harness.stores.small_disk import fill, small_disk

SEGMENT_S = 1.0
"""Short segments, so that kills also hit their sealing [s]."""
MAX_MISSING_S = 1.0
MAX_AGE_S = 3.0
"""Longest time from the start of the recording to the kill [s]."""


@dataclass
class Killed:
    """A killed agent: the periods that it executed, and its recording after the recovery.

    Attributes:
        executed: Number of each period → monotonic clock [s].
        segments: Numbers of the recorded rows of each segment.
    """

    executed: dict[int, float]
    segments: list[list[int]]

    @property
    def recorded(self) -> list[int]:
        return [number for segment in self.segments for number in segment]

    @property
    def missing_s(self) -> float:
        """Time from the last recorded to the last executed period [s]."""
        last = self.recorded[-1]
        return max(0.0, max(self.executed.values()) - self.executed[last]) if last in self.executed else 0.0

    @property
    def delay_s(self) -> float:
        """Longest time between two periods: how long this machine suspended the agent [s]."""
        return max(later - earlier for earlier, later in pairwise(self.executed.values()))


class Agent:
    """The agent of ``tests.harness.agent.recordings.agent`` in its process."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        command = [sys.executable, "-m", "tests.harness.agent.recordings.agent", str(folder), str(SEGMENT_S)]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        self.executed: dict[int, float] = {}
        self.recorder = 0
        while not self.recorder:
            self.read()

    def read(self) -> float:
        """Read one line; returns the time of the newest period [s]."""
        assert self.process.stdout is not None
        name, value = self.process.stdout.readline().split()
        if name == "recorder":
            self.recorder = int(value)
            return 0.0
        self.executed[int(name)] = int(value) / 1e9
        return self.executed[int(name)]

    def run(self, duration_s: float) -> None:
        until_s = self.read() + duration_s
        while self.read() < until_s:
            pass

    def kill(self) -> Killed:
        """Kill both processes, and recover the recording as the next start does."""
        os.kill(self.recorder, signal.SIGKILL)
        self.kill_agent()
        return Killed(self.executed, self.recover())

    def kill_agent(self) -> None:
        self.process.kill()
        rest, _ = self.process.communicate()
        for line in rest.split("\n"):
            number, _, time_ns = line.partition(" ")
            if time_ns.isdecimal():
                self.executed[int(number)] = int(time_ns) / 1e9

    def recover(self) -> list[list[int]]:
        files = RecordingFolder(self.folder / "recordings")
        for live in files.live():
            live_sequences(live)  # the reader opens it before the recovery
        worker = RecorderWorker(limits(files.folder))

        def sealed() -> bool:
            worker._maintained_s = float("-inf")
            worker.maintain()
            return not files.live()

        eventually(sealed)
        segments = sorted(files.segments(), key=lambda each: each.segment)
        assert all(overview_of(each.path).exists() for each in segments)
        return [[row["sequence"] for row in sealed_messages(each.path)] for each in segments]


def check(killed: Killed) -> None:
    assert killed.recorded == list(range(len(killed.recorded)))
    assert killed.missing_s <= MAX_MISSING_S + killed.delay_s


def kill_at_random_moments(folder: Path, count: int, seed: int) -> list[float]:
    """Missing time after each kill [s]."""
    rng = random.Random(seed)
    missing = []
    for number in range(count):
        home = folder / str(number)
        home.mkdir()
        agent = Agent(home)
        agent.run(rng.uniform(0.05, MAX_AGE_S))
        killed = agent.kill()
        check(killed)
        missing.append(killed.missing_s)
    return missing


def test_a_killed_agent_loses_at_most_the_last_second(tmp_path: Path) -> None:
    kill_at_random_moments(tmp_path, 3, seed=1)


@pytest.mark.long
def test_a_killed_agent_loses_at_most_the_last_second_at_fifty_moments(tmp_path: Path) -> None:
    missing = kill_at_random_moments(tmp_path, 50, seed=2)
    print(f"missing: at most {max(missing):.3f} s, median {sorted(missing)[len(missing) // 2]:.3f} s")


def test_a_killed_recorder_leaves_a_gap_of_at_most_a_second(tmp_path: Path) -> None:
    agent = Agent(tmp_path)
    agent.run(random.Random(3).uniform(0.5, 2.5))
    os.kill(agent.recorder, signal.SIGKILL)
    agent.run(4.0)
    agent.kill_agent()
    recorded = [number for segment in agent.recover() for number in segment]
    assert recorded == sorted(set(recorded))
    times = agent.executed
    gaps = [times[later] - times[earlier] for earlier, later in pairwise(recorded) if {earlier, later} <= times.keys()]
    delay_s = max(later - earlier for earlier, later in pairwise(times.values()))
    assert max(gaps) <= MAX_MISSING_S + delay_s
    assert recorded[-1] > min(times) + 125


# ------------------------------------------------------------ full disk


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 2) as folder:
        yield folder


@pytest.fixture
def recorder(disk: Path) -> Iterator[Recorder]:
    made = Recorder(limits(disk / "recordings"), owner="s/ann")
    yield made
    made.stop()


@pytest.fixture
def recorded(recorder: Recorder, tmp_path: Path) -> Iterator[DeviceHarness]:
    """A device whose recordings, and nothing else, are on the small disk."""
    harness = DeviceHarness(tmp_path, recorder=recorder)
    recorder.start()
    harness.start()
    yield harness
    harness.stop()


def faults(state: State) -> list[Any]:
    return [fault for fault in state.faults if fault.code == "recording"]


def test_a_full_disk_stops_the_recording_but_not_control(
    recorded: DeviceHarness, recorder: Recorder, disk: Path
) -> None:
    recorded.done(GrantLease(holder="ann", lease_ms=600_000), epoch=3)
    wait_for_state(recorded, lambda state: state.recording)
    filler = fill(disk)
    failed = wait_for_state(recorded, lambda state: not state.recording and faults(state))
    assert "No space left" in faults(failed)[0].message
    assert eventually(lambda: recorded.events(EventKind.RECORDING_FAILED))[0].data == {"epoch": 3}
    before = recorded.driver.position[1]
    recorded.setpoint(3, 1, elbow=before + 0.004)
    eventually(lambda: recorded.driver.position[1] > before)
    filler.unlink()
    resumed = wait_for_state(recorded, lambda state: state.recording)
    assert resumed.lease is not None
    recorded.device.stop()  # otherwise its next period begins another session
    recorder.stop()
    segments = sorted(RecordingFolder(disk / "recordings").segments(), key=lambda each: each.segment)
    # Between the first and the last one, an attempt may have found a little space.
    first, *_, last = ([row["sequence"] for row in sealed_messages(each.path)] for each in segments)
    assert first[0] == 0
    assert last[0] > first[-1] + 1
    assert eventually(lambda: recorded.events(EventKind.RECORDING_RESUMED))
