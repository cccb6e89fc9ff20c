"""The outcome of a Stop while the process of a real agent runs, is suspended, and continues."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.agent.pairing import paired_arm
from tests.harness.cloud.cloud_processes import start_cloud_processes
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT


@pytest.mark.timeout(300)
def test_a_stop_of_a_suspended_agent_is_sent_then_unreachable_and_confirmed_when_it_continues(tmp_path: Path) -> None:
    with start_cloud_processes("mosquitto", tmp_path / "cloud") as processes:
        device = paired_arm(processes, tmp_path / "agent")

        def outcome() -> str:
            answer: str = processes.anna.post(f"/devices/{device}/stop").json()["outcome"]
            return answer

        command = [sys.executable, "-m", "device_agent", "run", "--home", str(tmp_path / "agent")]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as agent:
            try:
                wait_until(lambda: processes.anna.get(f"/devices/{device}").json()["online"], "the agent")
                wait_until(lambda: outcome() == "confirmed", "a confirmed Stop")
                os.kill(agent.pid, signal.SIGSTOP)
                assert outcome() in {"sent", "unreachable"}
                wait_until(lambda: outcome() == "unreachable", "the will of the agent")
                os.kill(agent.pid, signal.SIGCONT)
                wait_until(lambda: outcome() == "confirmed", "a confirmed Stop")
            finally:
                agent.kill()
