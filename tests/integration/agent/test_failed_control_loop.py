"""The control loop of a real agent process ends or hangs in motion, as seen through broker and HTTP API."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.cli.run import EXIT_FAILED
from tests.harness.agent.pairing import paired_arm
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import PATIENCE_S, wait_until
from tests.harness.paths import ROOT

MOVE = {"kind": "move_joints", "position_rad": {"shoulder_pan": 3.0}, "speed": 0.1}
PROGRAM = """
import signal, sys, threading
from device_agent.__main__ import main
from device_agent.drivers.mujoco import MujocoDriver
from device_agent.runtime.control.control_loop import ControlLoop

def fail(_loop):
    raise RuntimeError("injected")

def hang(_driver):
    threading.Event().wait()

signal.signal(signal.SIGUSR1, lambda *_: setattr(ControlLoop, "_wait", fail))
signal.signal(signal.SIGUSR2, lambda *_: setattr(MujocoDriver, "observe", hang))
sys.exit(main(sys.argv[1:]))
"""
"""The agent's program. SIGUSR1 ends its control loop by an exception; SIGUSR2 makes the driver hang."""


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CloudProcesses]:
    with start_cloud_processes("mosquitto", tmp_path_factory.mktemp("failed-loop")) as processes:
        yield processes


class Arm:
    """A paired arm and its agent process."""

    def __init__(self, processes: CloudProcesses, folder: Path, transport: str) -> None:
        self.processes, self.folder = processes, folder
        self.id = paired_arm(processes, folder, transport=transport)

    @contextlib.contextmanager
    def running(self) -> Iterator["subprocess.Popen[bytes]"]:
        command = [sys.executable, "-c", PROGRAM, "run", "--home", str(self.folder)]
        with (
            (self.folder / "log").open("ab") as log,
            subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log) as process,
        ):
            try:
                wait_until(lambda: self.get()["online"], "the agent to be online")
                yield process
            finally:
                process.kill()

    def get(self) -> dict[str, Any]:
        device: dict[str, Any] = self.processes.anna.get(f"/devices/{self.id}").json()
        return device

    def faults(self) -> list[str]:
        return [fault["code"] for fault in (self.get()["state"] or {}).get("faults", ())]

    def stop(self) -> str:
        outcome: str = self.processes.anna.post(f"/devices/{self.id}/stop").json()["outcome"]
        return outcome


@pytest.mark.timeout(400)
@pytest.mark.parametrize("transport", ["mqtt", "http"])
@pytest.mark.parametrize("failure", ["dead", "hanging"])
def test_a_failed_loop_is_reported_confirms_no_stop_and_ends_the_process(
    processes: CloudProcesses, tmp_path: Path, transport: str, failure: str
) -> None:
    arm = Arm(processes, tmp_path, transport)
    with arm.running() as process:
        action = processes.anna.start(arm.id, request=MOVE, wait_ms=20_000, wait_for="started").json()
        assert action["status"] == "started"
        os.kill(process.pid, signal.SIGUSR1 if failure == "dead" else signal.SIGUSR2)
        failed_s = time.monotonic()
        wait_until(lambda: "agent.control-loop" in arm.faults(), "the fault in the API")
        print(f"{transport}, {failure}: reported by the API after {time.monotonic() - failed_s:.2f} s")
        assert arm.get()["state"]["mode"] == "fault"
        while process.poll() is None:
            assert arm.stop() != "confirmed"
        assert process.wait(PATIENCE_S) == EXIT_FAILED
        print(f"{transport}, {failure}: process ended after {time.monotonic() - failed_s:.2f} s")
        wait_until(lambda: not arm.get()["online"], "the agent to be offline")
        assert arm.stop() == "unreachable"
    with arm.running():
        wait_until(lambda: arm.stop() == "confirmed", "a confirmed Stop of the next process")
