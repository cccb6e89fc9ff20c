"""A running agent follows a move to another space and a change of its owner without a restart."""

import asyncio
import contextlib
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import uvicorn

from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

NUDGE = {"kind": "move_joints", "position_rad": {"wrist_3": 0.1}, "speed": 1.0}
MOST_S = 120.0
CODE = re.compile(r"claim code (\S+)  ")


@contextlib.contextmanager
def served(cloud: Cloud) -> Iterator[str]:
    """Serve the functions for a separate process; yields the address."""
    listener = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(cloud.app, log_level="warning", lifespan="off"))
    running = asyncio.run_coroutine_threadsafe(server.serve(sockets=[listener]), cloud.loop)
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        running.result(MOST_S)


@contextlib.contextmanager
def agent(home: Path) -> Iterator[None]:
    """The agent's program."""
    log = (home / "log").open("w")
    process = subprocess.Popen(
        [sys.executable, "-m", "device_agent", "run", "--home", str(home)], cwd=ROOT, stdout=log, stderr=log
    )
    try:
        yield
        assert process.poll() is None, (home / "log").read_text()
    finally:
        process.terminate()
        assert process.wait(MOST_S) == 0
        log.close()


def enroll(home: Path, *more: str) -> str:
    """Enroll the agent; returns its claim code."""
    done = subprocess.run(
        [sys.executable, "-m", "device_agent", "enroll", "--home", str(home), "--no-wait", *more],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    found = CODE.search(done.stdout)
    assert found is not None, done
    return found[1]


def runs_in(person: Person, device: str, space: str) -> None:
    """Assert that the device is online in this space and executes an action."""

    def available() -> bool:
        body = person.get(f"/devices/{device}").json()
        return bool(body["online"] and body["space"] == space)

    wait_until(available, "the agent to be online again", timeout_s=MOST_S)
    answer = person.start(device, request=NUDGE, wait_ms=30_000, wait_for="done")
    assert answer.json()["status"] == "done", answer.json()


def test_an_agent_follows_to_another_space_and_to_another_owner(cloud: Cloud, tmp_path: Path) -> None:
    anna, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
    home = tmp_path / "agent"
    with served(cloud) as url:
        code = enroll(home, "--server", url, "--device", "arm=ur5")
        claimed = anna.post("/agents/claim", {"code": code}).json()
        device = claimed["devices"][0]["id"]
        with agent(home):
            runs_in(anna, device, claimed["space"])
            attic = anna.post("/spaces", {"name": "Attic"}).json()["id"]
            assert anna.put(f"/agents/{claimed['agent']}/space", {"space": attic}).status_code == 200
            runs_in(anna, device, attic)
            assert anna.delete(f"/agents/{claimed['agent']}").status_code == 204
            wait_until(lambda: CODE.search((home / "log").read_text()), "a new claim code", timeout_s=MOST_S)
            claimed_again = bert.post("/agents/claim", {"code": CODE.findall((home / "log").read_text())[-1]})
            assert claimed_again.status_code == 200, claimed_again.text
            runs_in(bert, device, claimed_again.json()["space"])
            assert anna.get(f"/devices/{device}").status_code == 404
