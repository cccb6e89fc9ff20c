"""The commands of README.md and use-the-api.md, and the example programs, against a running product."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness.browser.product import Api, Machine, run_module
from tests.harness.documents import SERVER, block
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

README = ROOT / "README.md"
API_GUIDE = ROOT / "docs" / "guides" / "use-the-api.md"
SCRIPTS = ROOT / "docs" / "reference" / "scripts.md"
EXAMPLES = ROOT / "examples"


def commands(page: Path, name: str, machine: Machine, home: Path) -> str:
    """A code block of a page, with the addresses and folder of the test."""
    text = block(page, "runs", name).replace(SERVER, machine.url).replace("8081", str(machine.port + 1))
    return text.replace(".telescope/", f"{home}/").replace("credentials.json", str(home / "credentials.json"))


def test_curl_pairs_a_second_robot_and_runs_a_movement_on_it(machine: Machine, tmp_path: Path) -> None:
    output = tmp_path / "agent.log"
    with output.open("w") as log:
        agent = subprocess.Popen(
            ["bash", "-e", "-c", commands(README, "agent", machine, tmp_path)],
            cwd=ROOT,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        wait_until(lambda: "claim code" in output.read_text(), "the claim code")
        code = re.search(r"claim code (\S+)", output.read_text())
        assert code
        pages = [(README, "curl"), (API_GUIDE, "mqtt"), (API_GUIDE, "control")]
        script = "\n".join(commands(page, name, machine, tmp_path) for page, name in pages)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", script],
            cwd=ROOT,
            env=os.environ | {"LINK": machine.sign_in_link().partition("#sign-in=")[2], "CODE": code[1]},
            capture_output=True,
            text=True,
            timeout=110,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr + output.read_text()
        assert '"status":"done"' in done.stdout.replace(" ", "")
        assert done.stdout.count('"position_rad"') >= 5
        assert '"epoch"' in done.stdout
    finally:
        os.killpg(agent.pid, signal.SIGTERM)
        agent.wait(20)
    with machine.api() as api:
        second = next(each for each in api.get("/devices")["items"] if each["name"] == "second")
        wait_until(lambda: not api.get(f"/devices/{second['id']}")["online"], "the agent to be offline")
        api.http.delete(f"/agents/{second['agent']}").raise_for_status()


@pytest.fixture(scope="module")
def api(machine: Machine) -> Iterator[Api]:
    with machine.api() as api:
        yield api


def run_example(machine: Machine, api: Api, *arguments: str) -> str:
    """Run a program of ``examples/`` with an API key of an operator; returns its output."""
    del api  # signed in, so the account exists
    named = ("--name", "examples", "--role", "operator")
    key = run_module("function_app", "api-key", *named, TELESCOPE_HOME=str(machine.home)).stdout.strip()
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / arguments[0]), *arguments[1:]],
        env=os.environ | {"TELESCOPE_URL": machine.url, "TELESCOPE_TOKEN": key},
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("program", "arguments", "expected"),
    [
        ("list_and_move.py", ("ur5", "wave"), "wave: done"),
        ("watch_telemetry.py", ("ur5", "--samples", "3"), "elbow"),
        ("stream_setpoints.py", ("ur5", "wrist_3", "0.2"), "reached"),
    ],
)
def test_each_example_program_runs(
    machine: Machine, api: Api, program: str, arguments: tuple[str, ...], expected: str
) -> None:
    api.free_device()
    assert expected in run_example(machine, api, program, *arguments)


@pytest.mark.parametrize("name", ["nod", "greet"])
def test_example_movements_run(api: Api, name: str) -> None:
    source = (EXAMPLES / "nod.py").read_text() if name == "nod" else block(SCRIPTS, "file", "movements/greet.py")
    api.http.put(f"/robot-types/ur5/movements/{name}", json={"source": source}).raise_for_status()
    body = {"request": {"kind": "run_movement", "name": name}, "wait_ms": 30_000, "wait_for": "done"}
    assert api.post(f"/devices/{api.free_device()['id']}/actions", body)["status"] == "done"
    api.http.delete(f"/robot-types/ur5/movements/{name}").raise_for_status()
