"""A swarm as its command runs it, against the real functions and both brokers: real agents on the wire."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.harness.cloud.cloud_processes import Ground, start_ground
from tests.harness.network.brokers import BrokerKind, wait_until
from tests.harness.paths import ROOT

COUNT = 20


def command(*options: str, token: str = "", link: str = "") -> "subprocess.Popen[str]":
    environment = {**os.environ, "TELESCOPE_TOKEN": token, "TELESCOPE_SIGN_IN": link}
    return subprocess.Popen(
        [sys.executable, "-m", "device_agent", "load-test", *options],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def devices(ground: Ground) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    cursor: str | None = None
    while True:
        page = ground.anna.get("/devices", params={"cursor": cursor} if cursor else {}).json()
        found += page["items"]
        cursor = page["cursor"]
        if cursor is None:
            return found


def obeys(ground: Ground, device: str) -> None:
    """A simulated robot moves, stops, and reports both."""
    move = {"request": {"kind": "move_joints", "position_rad": {"joint_1": 0.2}}, "wait_for": "done", "wait_ms": 20_000}
    done = ground.anna.post(f"/devices/{device}/actions", move).json()
    assert done["status"] == "done", done
    assert done["result"] == {"position_rad": {"joint_1": pytest.approx(0.2), "joint_2": 0.0}}
    assert ground.anna.post(f"/devices/{device}/stop").json() == {"confirmed": True}
    refused = ground.anna.post(f"/devices/{device}/actions", move).json()
    assert (refused["status"], refused["reason"]["code"]) == ("failed", "stopped"), refused
    assert ground.anna.post(f"/devices/{device}/stop/reset").json() == {"confirmed": True}


@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", ["amqtt", "mosquitto"])
def test_twenty_agents_are_claimed_come_on_line_obey_and_leave(kind: BrokerKind, tmp_path: Path) -> None:
    with start_ground(kind, tmp_path / "ground") as ground:
        plan = ["--cloud", ground.url, "--home", str(tmp_path / "home"), "--count", str(COUNT), "--joints", "2"]
        timing = ["--rate-hz", "2", "--seconds", "60", "--spread-s", "1", "--every-s", "1"]
        figures = tmp_path / "figures.json"
        who = {"token": ground.anna.token} if kind == "amqtt" else {"link": ground.cloud.link("anna")}
        with command(*plan, *timing, "--json", str(figures), **who) as swarm:
            wait_until(lambda: sum(each["online"] for each in devices(ground)) == COUNT, "all on line", 120)
            one = devices(ground)[0]
            assert one["robot_type"] == "load-test-arm"
            obeys(ground, one["id"])
            swarm.terminate()
            said, _ = swarm.communicate(timeout=60)
        assert swarm.returncode == 0, said
        assert f"{COUNT} of {COUNT} connected" in said
        told = json.loads(figures.read_text())
        assert json.loads(said.splitlines()[-1]) == told
        assert (told["agents"], told["most_connected"], told["unconfirmed"], told["troubles"]) == (COUNT, COUNT, 0, {})
        assert told["counts"]["heard"] >= 3
        assert told["counts"]["lost_links"] == 0
        wait_until(lambda: not any(each["online"] for each in devices(ground)), "all to have said goodbye")

        # The next run reuses the agents, so no claim is necessary.
        again = command(*plan, "--rate-hz", "2", "--seconds", "4", "--spread-s", "1")
        said, _ = again.communicate(timeout=120)
        assert again.returncode == 0, said
        assert len(devices(ground)) == COUNT


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--cloud", "nowhere"), "--cloud: 'nowhere' is not an address"),
        (("--cloud", "http://127.0.0.1:1", "--count", "0"), "--count: 0 is not between 1 and 20000"),
        (("--cloud", "http://127.0.0.1:1", "--type", "no type"), "--type: 'no type' is not"),
        (("--cloud", "http://127.0.0.1:1", "--count", "1"), "cannot be reached"),
    ],
)
def test_what_cannot_be_run_is_said_in_one_line(tmp_path: Path, options: tuple[str, ...], told: str) -> None:
    swarm = command(*options, "--home", str(tmp_path))
    said, _ = swarm.communicate(timeout=60)
    assert swarm.returncode == 1
    (line,) = said.splitlines()
    assert line.startswith("telescope agent: ")
    assert told in line
