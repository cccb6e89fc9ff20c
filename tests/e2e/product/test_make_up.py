"""``make up``: the ready line, persistent data, restarts, and each start failure."""

import contextlib
import functools
import os
import signal
import socket
import sqlite3
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.harness.browser.product import PORTS, Machine, moves, ready_link, run_module, start_machine
from tests.harness.network.brokers import BROKERS, MODULES, wait_until
from tests.harness.network.ports import free_port


def error_line(machine: Machine) -> str:
    """The one error line of a failed start. Fails on a traceback."""
    assert machine.process.wait(30) != 0
    # Output may arrive after the exit.
    wait_until(lambda: any(line.strip() and line != "telescope: starting\n" for line in machine.lines), "output")
    text = "".join(machine.lines)
    assert "Traceback" not in text
    lines = [line for line in machine.lines if line.strip() and line != "telescope: starting\n"]
    assert len(lines) == 1, text
    return lines[0]


def listeners(machine: Machine) -> list[str]:
    """Addresses on which the three ports of the product listen."""
    hosts = []
    for family in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{family}").read_text().splitlines()[1:]:
            address, state = line.split()[1], line.split()[3]
            host, _, port = address.rpartition(":")
            if state == "0A" and 0 <= int(port, 16) - machine.port < 3:
                hosts.append(host)
    return hosts


@pytest.mark.parametrize("broker", BROKERS)
def test_start_and_clean_exit_keep_the_data(tmp_path: Path, broker: str) -> None:
    with start_machine(tmp_path, TELESCOPE_BROKER=broker) as first:
        assert first.ready.count("\n") == 1
        assert f"{first.url}/ " in first.ready
        assert "  renderer OSMesa (" in first.ready
        link = ready_link(first.ready)
        token = link.partition("#sign-in=")[2]
        assert httpx.post(f"{first.url}/api/v1/auth/sign-in", json={"link": token}).status_code == 200
        assert httpx.post(f"{first.url}/api/v1/auth/sign-in", json={"link": token}).status_code == 401
        with first.api() as api:
            device = api.device()
            api.http.put("/robot-types/ur5/movements/mine", json={"source": "robot.home()\n"}).raise_for_status()
        assert set(listeners(first)) == {"0100007F"}, "a port listens beyond loopback"
        children = [
            first.pid(words)
            for words in (MODULES[broker], "function_app serve", "function_app work", "-m device_agent")
        ]
        assert first.interrupt() == 0
        for pid in children:
            assert not Path(f"/proc/{pid}").exists()
        assert "Traceback" not in "".join(first.lines)
    with start_machine(tmp_path, port=first.port, TELESCOPE_BROKER=broker) as second, second.api() as api:
        assert api.device()["id"] == device["id"]
        assert "mine" in [each["name"] for each in api.get("/robot-types/ur5/movements")["items"]]


def test_every_killed_process_is_restarted(tmp_path: Path) -> None:
    with start_machine(tmp_path) as machine, machine.api() as api:
        device = api.device()
        for words in ("infra.embedded_broker", "function_app serve", "function_app work", "-m device_agent"):
            machine.kill(words)
            wait_until(functools.partial(_runs, machine, words), f"{words} to be started again")
        wait_until(lambda: moves(api, device["id"]), "the robot to move again")


def _runs(machine: Machine, words: str) -> bool:
    try:
        machine.pid(words)
    except AssertionError:
        return False
    return True


def test_a_killed_supervisor_leaves_no_processes(tmp_path: Path) -> None:
    with start_machine(tmp_path) as machine:
        children = [
            machine.pid(words)
            for words in ("infra.embedded_broker", "function_app serve", "function_app work", "-m device_agent")
        ]
        machine.process.send_signal(signal.SIGKILL)
        wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children), "the other processes to end")


@pytest.mark.parametrize("offset", [0, 1, 2])
def test_a_port_in_use_is_named(tmp_path: Path, offset: int) -> None:
    port = free_port(PORTS)
    with socket.create_server(("127.0.0.1", port + offset)), start_machine(tmp_path, port=port) as machine:
        line = error_line(machine)
        assert f"port {port + offset}" in line
        assert "TELESCOPE_PORT" in line


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"TELESCOPE_PORT": "eighty"}, "TELESCOPE_PORT"),
        ({"TELESCOPE_PORT": "70000"}, "TELESCOPE_PORT"),
        ({"TELESCOPE_BROKER": "carrier-pigeon"}, "amqtt or mosquitto"),
        ({"TELESCOPE_HOME": "/proc/nothing"}, "TELESCOPE_HOME"),
    ],
)
def test_an_invalid_setting_is_named(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    with start_machine(tmp_path, **settings) as machine:
        assert message in error_line(machine)


@pytest.mark.parametrize("package", ["ruckig", "fastapi"])
def test_a_missing_package_is_named(tmp_path: Path, package: str) -> None:
    hide = tmp_path / "hide"
    hide.mkdir()
    (hide / "sitecustomize.py").write_text(
        "import sys\n"
        "class Hide:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] == {package!r}:\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Hide())\n"
    )
    with start_machine(tmp_path / "home", PYTHONPATH=str(hide)) as machine:
        line = error_line(machine)
        assert f"'{package}'" in line
        assert "make env" in line


@pytest.mark.parametrize("damaged_from", [0, 4096], ids=["header", "pages"])
def test_a_damaged_database_is_named_and_unchanged(tmp_path: Path, damaged_from: int) -> None:
    with start_machine(tmp_path) as machine:
        machine.interrupt()
    (database,) = tmp_path.glob("*.sqlite")
    with contextlib.closing(sqlite3.connect(database)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    intact = database.read_bytes()
    damaged = intact[:damaged_from] + os.urandom(len(intact) - damaged_from)
    database.write_bytes(damaged)
    with start_machine(tmp_path, port=machine.port) as again:
        assert str(database) in error_line(again)
    assert database.read_bytes() == damaged


def test_every_program_has_help() -> None:
    for program in (["device_agent"], ["device_agent", "enroll"], ["device_agent", "run"], ["function_app"]):
        assert run_module(*program, "--help").stdout.startswith("usage:")


def test_the_agent_reports_wrong_arguments_in_one_line(tmp_path: Path) -> None:
    cases = {
        ("run",): "enroll",
        ("enroll", "--server", "http://127.0.0.1:1"): "--device",
        ("enroll", "--device", "arm=ur5"): "--server",
        ("enroll", "--server", "http://127.0.0.1:1", "--device", "arm"): "NAME=TYPE",
        ("enroll", "--server", "http://127.0.0.1:1", "--device", "arm=ur5:warp"): "mujoco",
        ("enroll", "--server", "http://127.0.0.1:1", "--device", "arm=ur5"): "cannot be reached",
    }
    for number, (arguments, message) in enumerate(cases.items()):
        done = run_module("device_agent", *arguments, "--home", str(tmp_path / str(number)))
        assert done.returncode != 0
        assert message in done.stderr, arguments
        assert len(done.stderr.splitlines()) == 1, done.stderr
