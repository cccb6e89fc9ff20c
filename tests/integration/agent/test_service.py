"""The agent's program as a service: unprivileged user, termination by signal, ``doctor`` while it runs."""

import atexit
import contextlib
import functools
import json
import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import PATIENCE_S, wait_until
from tests.harness.paths import ROOT

USER = 65_534
MOVE = {"kind": "move_joints", "position_rad": {"shoulder_pan": 0.1}, "speed": 1.0}
ENVIRONMENT = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
SCRIPT = {"kind": "run_movement", "name": "mine"}


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CloudProcesses]:
    with start_cloud_processes("amqtt", tmp_path_factory.mktemp("service")) as processes:
        processes.anna.put("/robot-types/ur5/movements/mine", {"source": "print('here')"})
        yield processes


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that the unprivileged user owns and can reach."""
    folder = Path(tempfile.mkdtemp(prefix="telescope-"))
    if os.geteuid() == 0:
        os.chown(folder, USER, USER)
    yield folder
    shutil.rmtree(folder)


def unprivileged(*arguments: str) -> list[str]:
    """The command, run by an unprivileged user."""
    if os.geteuid() != 0:
        return [sys.executable, *arguments]
    drop = ["setpriv", f"--reuid={USER}", f"--regid={USER}", "--clear-groups", "--no-new-privs"]
    return [*drop, str(_reachable_python()), *arguments]


@functools.cache
def _reachable_python() -> Path:
    """This Python; if only root can run it, the system's of the same version with these packages."""
    real = Path(sys.executable).resolve()
    if all(folder.stat().st_mode & 0o005 == 0o005 for folder in real.parents):
        return Path(sys.executable)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    found = shutil.which(version, path="/usr/bin:/usr/local/bin")
    assert found is not None, f"only root can run {real}, and no other {version} is installed"
    place = Path(tempfile.mkdtemp(prefix="telescope-python-"))
    atexit.register(shutil.rmtree, place)
    place.chmod(0o755)
    for folder in ("bin", f"lib/{version}"):
        (place / folder).mkdir(parents=True)
    (place / "pyvenv.cfg").write_text(f"home = {Path(found).parent}\ninclude-system-site-packages = false\n")
    (place / "bin/python").symlink_to(found)
    (place / "lib" / version / "site-packages").symlink_to(sysconfig.get_path("purelib"))
    return place / "bin/python"


def program(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = unprivileged(*arguments, "--home", str(folder / "agent"))
    return subprocess.run(command, cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, check=False)


def enroll(processes: CloudProcesses, folder: Path, *options: str) -> str:
    """Enroll the agent and claim it for Anna; returns the device's id."""
    enroll = ("-m", "device_agent", "enroll", "--server", processes.url, "--device", "arm=ur5", "--no-wait", *options)
    done = program(folder, *enroll)
    code = re.search(r"claim code (\S+)  ", done.stdout)
    assert code is not None, done
    device: str = processes.anna.post("/agents/claim", {"code": code[1]}).json()["devices"][0]["id"]
    return device


@contextlib.contextmanager
def running(folder: Path, *arguments: str, **environment: str) -> Iterator["subprocess.Popen[bytes]"]:
    command = unprivileged(*arguments, "run", "--home", str(folder / "agent"))
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT | environment, stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def online(processes: CloudProcesses, device: str) -> bool:
    state: bool = processes.anna.get(f"/devices/{device}").json()["online"]
    return state


def end_of(processes: CloudProcesses, device: str, request: Any) -> dict[str, Any]:
    """Start an action and wait for its end."""
    action: dict[str, Any] = processes.anna.start(device, request=request, wait_ms=30_000, wait_for="done").json()
    return action


def findings(folder: Path) -> dict[str, str]:
    """Findings of ``doctor`` by check. Asserts that none is a problem."""
    done = program(folder, "-m", "device_agent", "doctor", "--json")
    assert "Traceback" not in done.stdout + done.stderr, done.stderr
    assert done.returncode == 0, done.stdout
    report = json.loads(done.stdout)
    assert report["ok"]
    return {each["check"]: f"{each['level']}: {each['message']}" for each in report["findings"]}


class ServiceManager:
    """Receives notifications, as systemd does."""

    def __init__(self, path: Path) -> None:
        self.notifications: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        path.chmod(0o666)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self._path = path

    def _run(self) -> None:
        while text := self._socket.recv(1000).decode():
            self.notifications.append(text)

    def close(self) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()


def test_enroll_reports_a_type_that_the_account_does_not_have_and_accepts_a_corrected_one(
    processes: CloudProcesses, folder: Path
) -> None:
    enroll(processes, folder)
    again = program(folder, "-m", "device_agent", "enroll", "--device", "arm=ur99")
    assert again.returncode == 1
    (line,) = [line for line in again.stderr.splitlines() if line.startswith("telescope agent:")]
    assert "robot type 'ur99' is not on this machine (known: " in line
    assert "ur5" in line
    assert program(folder, "-m", "device_agent", "enroll", "--device", "arm=ur5").returncode == 0


def test_the_service_runs_unprivileged_and_ends_on_a_signal(processes: CloudProcesses, folder: Path) -> None:
    device = enroll(processes, folder, "--transport", "http")
    home, notify = folder / "agent", folder / "notify"
    with (
        contextlib.closing(ServiceManager(notify)) as manager,
        running(folder, "-m", "device_agent", NOTIFY_SOCKET=str(notify)) as process,
    ):
        wait_until(lambda: any("STATUS=running" in text for text in manager.notifications), "the agent to be ready")
        wait_until(lambda: "WATCHDOG=1" in manager.notifications[-1], "the watchdog")
        wait_until(lambda: online(processes, device), "the agent to be online")
        assert end_of(processes, device, MOVE)["status"] == "done"
        script = end_of(processes, device, SCRIPT)
        assert (script["status"], script["output"].strip()) == ("done", "here"), script

        second = program(folder, "-m", "device_agent", "run")
        assert (second.returncode, "already" in second.stderr) == (1, True), second.stderr
        report = findings(folder)
        assert report["user"].startswith("ok")
        assert report["scripts"].startswith(("ok", "warning"))
        assert "not tested" in report["link"]

        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    wait_until(lambda: not online(processes, device), "the agent to be offline")
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in home.iterdir()}
    assert stat.S_IMODE(home.stat().st_mode) == 0o700
    assert {"identity.pem", "agent.toml", "pairing.json", "journal.db"} <= modes.keys()
    assert modes.pop("recordings") == 0o700
    assert set(modes.values()) == {0o600}, modes
    assert "connected" in findings(folder)["link"]


ELSEWHERE = """
import asyncio, json, multiprocessing.connection, ssl, subprocess, sys, tempfile, zoneinfo
import cryptography.hazmat.primitives.asymmetric.ed25519, jwt, msgspec, mujoco, numpy, paho.mqtt.client, requests
import ruckig, cryptography.hazmat.primitives.serialization, requests.adapters, urllib3.connectionpool, requests.auth
import os, signal, socket
for name in ("fcntl", "resource", "pwd", "grp", "termios", "pyseccomp", "slixmpp"):
    sys.modules[name] = None
for name in ("geteuid", "getuid", "fork", "pidfd_open", "getresuid", "setresuid", "killpg", "waitid"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGKILL", "SIGSTOP", "SIGHUP", "pidfd_send_signal"):
    if hasattr(signal, name):
        delattr(signal, name)
for name in ("SOCK_SEQPACKET", "send_fds", "recv_fds", *(("AF_UNIX",) if PLATFORM == "win32" else ())):
    delattr(socket, name)
sys.platform = PLATFORM
from device_agent.__main__ import main
sys.exit(main(sys.argv[1:]))
"""
"""The agent's program without the features of Unix; libraries are imported before these are removed."""


@pytest.mark.parametrize("platform", ["win32", pytest.param("darwin", marks=pytest.mark.long)])
def test_without_a_sandbox_the_service_runs_without_scripts(
    processes: CloudProcesses, folder: Path, platform: str
) -> None:
    device = enroll(processes, folder, "--transport", "http" if platform == "win32" else "mqtt")
    source = ELSEWHERE.replace("PLATFORM", repr(platform))
    with running(folder, "-c", source) as process:
        wait_until(lambda: online(processes, device) or process.poll() is not None, "the agent to be online")
        assert process.poll() is None, (folder / "log").read_text()
        assert end_of(processes, device, MOVE)["status"] == "done"
        script = end_of(processes, device, SCRIPT)
        assert script["status"] == "failed"
        assert "scripts run on Linux only" in script["reason"]["message"]
        assert end_of(processes, device, MOVE)["status"] == "done"
    done = program(folder, "-c", source, "doctor")
    assert done.returncode == 0, done
    assert "warning  scripts: scripts run on Linux only" in done.stdout
    assert "Traceback" not in done.stderr
