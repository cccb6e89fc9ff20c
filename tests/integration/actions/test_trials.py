"""Trials with the real agent, the simulated gripper arm and the real functions: only real successes are stored."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.config.agent_config import DeviceEntry
from tests.harness.agent.pairing import paired_devices
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

TYPE, TASK = "ur5_gripper", "red_cube_in_green_tray"
SEED = 3
WITHIN_MS = 600_000


class Site:
    """Functions, broker, and the agent of one simulated arm."""

    def __init__(self, processes: CloudProcesses, device: str) -> None:
        self.anna = processes.anna
        self.url = processes.url
        self.device = device

    def run(self, seed: int) -> dict[str, Any]:
        """Run one trial to its end; returns its row."""
        request = {"kind": "run_trial", "name": TASK, "seed": seed}
        started = self.anna.start(self.device, request=request, timeout_ms=WITHIN_MS, wait_ms=20_000)
        assert started.status_code in {200, 202}, started.text
        action = started.json()["id"]
        wait_until(lambda: self.ended(action), "the end of the trial", WITHIN_MS / 1000)
        return next(trial for trial in self.trials() if trial["action"] == action)

    def ended(self, action: str) -> bool:
        return self.anna.action(action, wait_ms=5_000)["status"] in {"done", "failed"}

    def trials(self) -> list[dict[str, Any]]:
        return self.anna.pages(f"/robot-types/{TYPE}/tasks/{TASK}/trials")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with start_cloud_processes("amqtt", tmp_path / "cloud") as processes:
        device = paired_devices(processes, tmp_path / "agent", [DeviceEntry(name="arm", type=TYPE)])["arm"]
        command = [sys.executable, "-m", "device_agent", "run", "--home", str(tmp_path / "agent")]
        with (tmp_path / "log").open("wb") as log, subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log) as agent:
            try:
                wait_until(lambda: processes.anna.get(f"/devices/{device}").json()["online"], "the agent")
                yield Site(processes, device)
            finally:
                agent.kill()


@pytest.mark.timeout(900)
def test_a_success_and_a_failure_become_rows(site: Site) -> None:
    success = site.run(SEED)
    assert (success["state"], success["cause"]) == ("success", ""), success
    assert (success["seed"], success["simulated"], success["movement"]) == (SEED, True, "pick_and_place")
    assert 5 < success["duration_s"] < 60

    # This movement ends without an error, as if it had succeeded, but has not touched the cube.
    source = "robot.home()\nprint('placed red_cube')\nprogress(1.0)"
    path = f"/robot-types/{TYPE}/movements/pick_and_place"
    assert site.anna.put(path, {"source": source}).status_code == 201
    failure = site.run(SEED)
    assert (failure["state"], failure["cause"]) == ("failed", "not_met"), failure
    assert failure["detail"] == "the robot did not lift the object"
    assert site.anna.action(failure["action"])["status"] == "done"

    report = site.anna.get(f"/robot-types/{TYPE}/tasks/{TASK}").json()
    assert (report["rate"]["trials"], report["rate"]["successes"]) == (2, 1)
    assert [trial["state"] for trial in site.trials()] == ["failed", "success"]


@pytest.mark.timeout(900)
def test_a_simulated_batch_is_published_with_an_api_key(site: Site, tmp_path: Path) -> None:
    created = site.anna.post("/api-keys", {"name": "trials", "role": "operator", "days": 1})
    key = tmp_path / "key"
    key.write_text(created.json()["token"], encoding="ascii")
    options = ["--task", f"{TYPE}/{TASK}", "--seeds", "1", "--first-seed", str(SEED), "--publish", site.url]
    command = [sys.executable, "-m", "device_agent", "trials", *options, "--api-key-file", str(key)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"published on {site.url}" in done.stdout
    report = site.anna.get(f"/robot-types/{TYPE}/tasks/{TASK}").json()
    (batch,) = report["batches"]
    assert (batch["first_seed"], batch["rate"]["trials"], batch["rate"]["successes"]) == (SEED, 1, 1)
    assert batch["published_by"] == "anna (trials)"
    assert report["rate"]["trials"] == 0
    assert site.trials() == []
