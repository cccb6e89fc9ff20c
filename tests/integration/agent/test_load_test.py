"""The load test against the real functions and both brokers, with simulated agents."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from device_agent.__main__ import main
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import BrokerKind, wait_until
from tests.harness.paths import ROOT

COUNT = 20


def start(*options: str, token: str = "", link: str = "") -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "device_agent", "load-test", *options],
        cwd=ROOT,
        env={**os.environ, "TELESCOPE_TOKEN": token, "TELESCOPE_SIGN_IN": link},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def devices(processes: CloudProcesses) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = []
    query: dict[str, str] = {}
    while True:
        page = processes.anna.get("/devices", params=query).json()
        items += page["items"]
        if page["cursor"] is None:
            return items
        query = {"cursor": page["cursor"]}


def require_motion_and_stop(processes: CloudProcesses, device: str) -> None:
    move = {"request": {"kind": "move_joints", "position_rad": {"joint_1": 0.2}}, "wait_for": "done", "wait_ms": 20_000}
    done = processes.anna.post(f"/devices/{device}/actions", move).json()
    assert done["status"] == "done", done
    assert done["result"] == {"position_rad": {"joint_1": pytest.approx(0.2), "joint_2": 0.0}}
    assert processes.anna.post(f"/devices/{device}/stop").json()["outcome"] == "confirmed"
    refused = processes.anna.post(f"/devices/{device}/actions", move).json()
    assert (refused["status"], refused["reason"]["code"]) == ("failed", "stopped"), refused
    assert processes.anna.post(f"/devices/{device}/stop/reset").json() == {"confirmed": True, "reason": None}


@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", ["amqtt", "mosquitto"])
def test_twenty_agents_are_claimed_operated_and_reused(kind: BrokerKind, tmp_path: Path) -> None:
    with start_cloud_processes(kind, tmp_path / "cloud") as processes:
        common = ["--cloud", processes.url, "--home", str(tmp_path / "home"), "--count", str(COUNT), "--joints", "2"]
        common += ["--rate-hz", "2", "--spread-s", "1"]
        figures = tmp_path / "figures.json"
        sign_in = {"token": processes.anna.token} if kind == "amqtt" else {"link": processes.cloud.link("anna")}
        with start(*common, "--seconds", "60", "--every-s", "1", "--json", str(figures), **sign_in) as load:
            wait_until(lambda: sum(each["online"] for each in devices(processes)) == COUNT, "all to be online", 120)
            device = devices(processes)[0]
            assert device["robot_type"] == "load-test-arm"
            require_motion_and_stop(processes, device["id"])
            load.terminate()
            output, _ = load.communicate(timeout=60)
        assert load.returncode == 0, output
        assert f" of {COUNT} connected" in output
        summary = json.loads(figures.read_text())
        assert json.loads(output.splitlines()[-1]) == summary
        assert [summary[name] for name in ("agents", "most_connected", "unconfirmed")] == [COUNT, COUNT, 0]
        assert summary["errors"] == {}
        assert summary["counts"]["received"] >= 3
        assert summary["counts"]["lost_links"] == 0
        wait_until(lambda: not any(each["online"] for each in devices(processes)), "all to be offline")

        # The next run reuses the agents, so no claim is necessary.
        again = start(*common, "--seconds", "4")
        output, _ = again.communicate(timeout=120)
        assert again.returncode == 0, output
        assert len(devices(processes)) == COUNT


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--cloud", "nowhere"), "--cloud: 'nowhere' is not an address"),
        (("--cloud", "http://127.0.0.1:1", "--count", "0"), "--count: 0 is not between 1 and 20000"),
        (("--cloud", "http://127.0.0.1:1", "--type", "no type"), "--type: 'no type' is not"),
        (("--cloud", "http://127.0.0.1:1", "--count", "1"), "cannot be reached"),
    ],
)
def test_errors_are_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], message: str
) -> None:
    assert main(["load-test", *options, "--home", str(tmp_path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("telescope agent: ")
    assert message in line
