"""The outcome of a Stop while the process of a real agent runs, is suspended, and continues."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock
from device_agent.transports.http.client import CloudClient
from device_agent.transports.pairing_monitor import SOFTWARE
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT


def paired_arm(processes: CloudProcesses, folder: Path, *, transport: str = "mqtt") -> str:
    """Pair an agent with a simulated arm; returns the id of the arm."""
    store = IdentityStore(folder)
    key = store.private_key(create=True)
    arm = DeviceEntry(name="arm", type="ur5")
    config = AgentConfig(server=processes.url, name="lab", devices=(arm,), transport=transport)
    config.save(store.folder)
    api = CloudClient(processes.url, key, CloudClock())
    claim = api.enroll(
        name="lab", software=SOFTWARE, transport=config.transport, devices=catalogue.enrolled_devices(config)
    )
    device: str = processes.anna.post("/agents/claim", {"code": claim.code}).json()["devices"][0]["id"]
    enrollment = api.enrollment()
    keys = {each["id"]: each["public"] for each in enrollment["keys"]}
    store.save_pairing(Pairing(agent=enrollment["agent"], space=enrollment["space"], account="anna", keys=keys))
    return device


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
