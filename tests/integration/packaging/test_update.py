"""Update and rollback of an installed agent with a simulated arm, by a real server, broker and service manager."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.cli.local_control import client
from device_agent.cli.local_control.messages import ControlRequest
from tests.harness.agent.agent_bundle import InstalledAgent, build_wheel, bundle
from tests.harness.agent.pairing import paired_arm
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import wait_until

LONG = {"kind": "move_joints", "position_rad": {"shoulder_pan": 2.0}, "speed": 0.002}
"""A motion that lasts until the test cancels it."""
FAST = {"kind": "move_joints", "position_rad": {"shoulder_pan": 0.0}, "speed": 1.0}
BROKEN = {"device_agent/bootstrap.py": ("        self._sandbox.start()\n", "        raise OSError('no driver')\n")}
"""A release that passes its self-test, and ends when it starts its devices."""

pytestmark = pytest.mark.timeout(1800)  # on a busy machine, the programs of an update start slowly


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CloudProcesses]:
    with start_cloud_processes("amqtt", tmp_path_factory.mktemp("update")) as processes:
        yield processes


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


def start(processes: CloudProcesses, device: str, request: Any, *, until: str) -> dict[str, Any]:
    """Start an action; returns it in this state."""
    action: dict[str, Any] = processes.anna.start(device, request=request, timeout_ms=1_800_000).json()

    def reached() -> bool:
        action.update(processes.anna.get(f"/actions/{action['id']}").json())
        return action["status"] == until or action["status"] in {"done", "failed", "cancelled", "expired"}

    wait_until(reached, f"the action to be {until}")
    return action


def online(processes: CloudProcesses, device: str) -> bool:
    state: bool = processes.anna.get(f"/devices/{device}").json()["online"]
    return state


def release_of(agent: InstalledAgent) -> str:
    """Version of the running release, as it answers itself; empty while none listens."""
    answer = client.call(agent.home, ControlRequest(kind="status"))
    return "" if answer is None else answer.version


def test_an_update_waits_for_rest_and_a_broken_release_is_rolled_back(
    processes: CloudProcesses, wheel: Path, tmp_path: Path
) -> None:
    agent = InstalledAgent(tmp_path)
    done = agent.install("--bundle", str(bundle(tmp_path, wheel, "0.1.0")))
    assert done.returncode == 0, done.stderr
    device = paired_arm(processes, agent.home)
    with agent:
        wait_until(lambda: release_of(agent) == "0.1.0" and online(processes, device), "the agent")
        _update_in_motion(processes, agent, device, bundle(tmp_path, wheel, "0.2.0"))
        _reject_motion_in_the_window(processes, agent, device)
        agent.clone("0.2.0", "0.3.0", BROKEN)
        broken = agent.run("rollback", "--version", "0.3.0")
        assert broken.returncode == 1, broken
        assert "release 0.3.0 failed (it ended 3 times before it was ready); release 0.2.0 is in use" in broken.stderr
        wait_until(lambda: release_of(agent) == "0.2.0" and online(processes, device), "the former release")
        assert start(processes, device, FAST, until="done")["status"] == "done"


def _update_in_motion(processes: CloudProcesses, agent: InstalledAgent, device: str, new: Path) -> None:
    """Run the update while the arm moves: it waits, and the motion goes on until its operator ends it."""
    action = start(processes, device, LONG, until="started")
    assert action["status"] == "started", action
    running = agent.pid
    output = ""
    with agent.begin("update", "--bundle", str(new)) as update:
        assert update.stdout is not None
        while "waiting: arm: " not in output:
            line = update.stdout.readline()
            assert line, output
            output += line
        moving = processes.anna.get(f"/actions/{action['id']}").json()
        assert (moving["status"], agent.pid, agent.starts) == ("started", running, 1), output
        assert processes.anna.post(f"/actions/{action['id']}/cancel").status_code < 300
        output += update.stdout.read()
    assert update.returncode == 0, output
    ended = processes.anna.get(f"/actions/{action['id']}").json()
    assert ended["status"] == "cancelled", "no restart ended the motion"
    assert 0.001 < ended["result"]["position_rad"]["shoulder_pan"] < 2.0
    assert "release 0.2.0 is in use and works" in output
    assert (release_of(agent), agent.starts) == ("0.2.0", 2)
    wait_until(lambda: online(processes, device), "the new release to be online")
    assert start(processes, device, FAST, until="done")["status"] == "done"


def _reject_motion_in_the_window(processes: CloudProcesses, agent: InstalledAgent, device: str) -> None:
    """Motion is rejected from the agent's agreement to the end of the permission."""
    permission = client.call(agent.home, ControlRequest(kind="request-restart"))
    assert permission is not None
    assert permission.ok, permission.reason
    rejected = start(processes, device, LONG, until="done")
    assert (rejected["status"], rejected["reason"]["code"]) == ("failed", "restarting"), json.dumps(rejected)
    assert "about to restart for an update" in rejected["reason"]["message"]
    cancelled = client.call(agent.home, ControlRequest(kind="cancel-restart", token=permission.token))
    assert cancelled is not None
    assert cancelled.ok
    assert start(processes, device, FAST, until="done")["status"] == "done"
