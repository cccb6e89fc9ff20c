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
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.harness.cloud.cloud_processes import Ground, start_ground
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

USER = 65_534
PATIENCE_S = 60.0
MINE = "/robot-types/ur5/movements/mine"
MOVE = {"kind": "move_joints", "position_rad": {"shoulder_pan": 0.1}, "speed": 1.0}
SCRIPT = {"kind": "run_movement", "name": "mine"}


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ground]:
    with start_ground("amqtt", tmp_path_factory.mktemp("service")) as ground:
        ground.anna.put(MINE, {"source": "print('here')"})
        yield ground


@pytest.fixture
def folder() -> Iterator[Path]:
    """A place that an unprivileged user can reach, and owns."""
    made = Path(tempfile.mkdtemp(prefix="telescope-"))
    if os.geteuid() == 0:
        os.chown(made, USER, USER)
    yield made
    shutil.rmtree(made)


def unprivileged(*arguments: str) -> list[str]:
    """The command, run by an unprivileged user."""
    if os.geteuid() != 0:
        return [sys.executable, *arguments]
    drop = ["setpriv", f"--reuid={USER}", f"--regid={USER}", "--clear-groups", "--no-new-privs"]
    return [*drop, str(_reachable_python()), *arguments]


@functools.cache
def _reachable_python() -> Path:
    """This Python; where it lives in root's own folder, the system's of the same version with these packages."""
    real = Path(sys.executable).resolve()
    if all(folder.stat().st_mode & 0o005 == 0o005 for folder in real.parents):
        return Path(sys.executable)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    found = shutil.which(version, path="/usr/bin:/usr/local/bin")
    assert found is not None, f"{real} can be run by root alone, and there is no other {version}"
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
    return subprocess.run(
        unprivileged("-m", "device_agent", *arguments, "--home", str(folder / "agent")),
        cwd=ROOT,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def claimed(ground: Ground, folder: Path, *more: str) -> str:
    """Enroll and be claimed by Anna; the device's id."""
    done = program(folder, "enroll", "--server", ground.url, "--device", "arm=ur5", "--no-wait", *more)
    found = re.search(r"claim code (\S+)  ", done.stdout)
    assert found is not None, done
    answer = ground.anna.post("/agents/claim", {"code": found[1]})
    device: str = answer.json()["devices"][0]["id"]
    return device


@contextlib.contextmanager
def running(command: list[str], folder: Path, environment: Mapping[str, str]) -> Iterator["subprocess.Popen[bytes]"]:
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            command, cwd=ROOT, env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1", **environment}, stdout=log, stderr=log
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def does(ground: Ground, device: str, request: Any) -> dict[str, Any]:
    """Start an action and wait for its end."""
    answer = ground.anna.start(device, request=request, wait_ms=30_000, wait_for="done")
    found: dict[str, Any] = answer.json()
    return found


def findings(folder: Path) -> tuple[int, dict[str, str]]:
    """What the doctor says: its exit code, and each check's worst level with its words."""
    done = program(folder, "doctor", "--json")
    assert "Traceback" not in done.stdout + done.stderr, done.stderr
    found = json.loads(done.stdout)
    assert found["ok"] == (done.returncode == 0), found
    return done.returncode, {each["check"]: f"{each['level']}: {each['message']}" for each in found["findings"]}


class Manager:
    """What a service manager hears."""

    def __init__(self, path: Path) -> None:
        self.heard: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        path.chmod(0o666)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self._path = path

    def _run(self) -> None:
        while word := self._socket.recv(1000).decode():
            self.heard.append(word)

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
            end.sendto(b"", str(self._path))
        self._thread.join()
        self._socket.close()


def test_it_runs_unprivileged_and_ends_on_a_signal(ground: Ground, folder: Path) -> None:
    device = claimed(ground, folder, "--transport", "http")
    manager = Manager(folder / "notify")
    run = unprivileged("-m", "device_agent", "run", "--home", str(folder / "agent"))
    with contextlib.closing(manager), running(run, folder, {"NOTIFY_SOCKET": str(folder / "notify")}) as process:
        wait_until(lambda: any("STATUS=running" in word for word in manager.heard), "it to be ready", PATIENCE_S)
        wait_until(lambda: "WATCHDOG=1" in manager.heard[-1], "a sign of life")
        wait_until(lambda: ground.anna.get(f"/devices/{device}").json()["online"], "it to be online", PATIENCE_S)
        assert does(ground, device, MOVE)["status"] == "done"
        script = does(ground, device, SCRIPT)
        assert (script["status"], script["output"].strip()) == ("done", "here"), script

        second = program(folder, "run")
        assert (second.returncode, "already" in second.stderr) == (1, True), second.stderr
        code, said = findings(folder)
        assert code == 0, said
        assert said["user"].startswith("ok")
        assert said["scripts"].startswith(("ok", "warning"))
        assert "not tested" in said["link"]

        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    wait_until(lambda: not ground.anna.get(f"/devices/{device}").json()["online"], "its goodbye")
    home = folder / "agent"
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in home.iterdir()}
    assert stat.S_IMODE(home.stat().st_mode) == 0o700
    assert {"identity.pem", "agent.toml", "pairing.json", "journal.db"} <= modes.keys()
    assert set(modes.values()) == {0o600}, modes
    code, said = findings(folder)
    assert code == 0, said
    assert "connected" in said["link"], said


ELSEWHERE = """
import asyncio, json, multiprocessing, ssl, subprocess, sys, tempfile, zoneinfo
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
"""The agent's program, on a system that has nothing of Unix's own. Libraries are imported before it becomes one."""


@pytest.mark.parametrize("platform", ["win32", pytest.param("darwin", marks=pytest.mark.long)])
def test_without_a_sandbox_it_runs_without_scripts(ground: Ground, folder: Path, platform: str) -> None:
    device = claimed(ground, folder, "--transport", "http" if platform == "win32" else "mqtt")
    source = ELSEWHERE.replace("PLATFORM", repr(platform))
    run = unprivileged("-c", source, "run", "--home", str(folder / "agent"))
    with running(run, folder, {}) as process:
        wait_until(
            lambda: ground.anna.get(f"/devices/{device}").json()["online"] or process.poll() is not None,
            "it to be online",
            PATIENCE_S,
        )
        assert process.poll() is None, (folder / "log").read_text()
        assert does(ground, device, MOVE)["status"] == "done"
        script = does(ground, device, SCRIPT)
        assert script["status"] == "failed"
        assert "scripts run on Linux only" in script["reason"]["message"]
        assert does(ground, device, MOVE)["status"] == "done", "all else goes on"
    done = subprocess.run(
        unprivileged("-c", source, "doctor", "--home", str(folder / "agent")),
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done
    assert "warning  scripts: scripts run on Linux only" in done.stdout
    assert "Traceback" not in done.stderr
