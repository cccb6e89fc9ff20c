"""``doctor`` names each problem with its remedy and never fails with a traceback."""

import logging
import os
import shutil
import socket
import sqlite3
import sys
import threading
from collections import namedtuple
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from device_agent import __main__ as program
from device_agent.cli import doctor
from device_agent.cli.doctor import cloud, devices, machine
from device_agent.cli.doctor.finding import Finding, warning
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.clock import CloudClock

ARM = DeviceEntry(name="arm", type="ur5")
PAIRING = Pairing(agent="a", space="s", account="anna", keys={})
Usage = namedtuple("Usage", "total used free")  # noqa: PYI024 (like shutil's)


@pytest.fixture
def store(tmp_path: Path) -> IdentityStore:
    """Enrolled but not paired; the server is unreachable."""
    store = IdentityStore(tmp_path / "agent")
    store.private_key(create=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        server = f"http://127.0.0.1:{free.getsockname()[1]}"
    AgentConfig(server=server, name="lab", devices=(ARM,)).save(store.folder)
    return store


def levels(findings: Iterator[Finding]) -> list[str]:
    listed = list(findings)
    assert all(each.level == "ok" or each.advice for each in listed)
    return [each.level for each in listed]


def text(findings: Iterator[Finding]) -> str:
    return " ".join(f"{each.level}: {each.message} → {each.advice}" for each in findings)


@pytest.mark.parametrize(("uid", "level"), [(0, "warning"), (1000, "ok"), (None, "ok")])
def test_running_as_root_is_a_warning(uid: int | None, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if uid is None:
        monkeypatch.delattr(os, "geteuid")
    else:
        monkeypatch.setattr(os, "geteuid", lambda: uid)
    assert levels(machine.user()) == [level]


def test_folder_must_exist_hold_an_agent_and_be_private(store: IdentityStore, tmp_path: Path) -> None:
    assert levels(machine.folder(store)) == ["ok"]
    assert "does not exist" in text(machine.folder(IdentityStore(tmp_path / "none")))
    assert "holds no agent" in text(machine.folder(IdentityStore(tmp_path)))
    store.folder.chmod(0o755)
    (store.folder / "agent.toml").chmod(0o640)
    assert levels(machine.folder(store)) == ["warning", "warning"]
    key = store.folder / "identity.pem"
    key.chmod(0o644)
    report = text(machine.folder(store))
    assert f"problem: other users of this machine can read {key}" in report
    assert f"chmod 600 {key}" in report


@pytest.mark.parametrize(("free", "level"), [(10**6, "problem"), (2 * 10**8, "warning"), (10**10, "ok")])
def test_low_disk_space_is_reported(
    free: int, level: str, store: IdentityStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(0, 0, free))
    assert levels(machine.disk(store)) == [level]


def test_damaged_journal_is_a_problem(store: IdentityStore) -> None:
    store.journal.write_bytes(b"not a database, and long enough to be mistaken for one" * 30)
    assert f"problem: {store.journal} is damaged" in text(machine.disk(store))
    store.journal.unlink()
    with sqlite3.connect(store.journal) as journal:
        journal.execute("CREATE TABLE commands (id TEXT)")
    journal.close()
    assert "journal.db is intact" in text(machine.disk(store))


def test_unconfined_scripts_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    assert "scripts run on Linux only" in text(machine.scripts(allow_unconfined=False))
    assert "with this agent's rights" in text(machine.scripts(allow_unconfined=True))
    assert levels(machine.python()) == ["warning"]


def test_missing_speech_synthesizer_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert levels(machine.voice()) == ["ok"]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "apt-get install espeak-ng" in text(machine.voice())


@pytest.mark.parametrize(
    ("entry", "level", "named"),
    [
        (ARM, "ok", "ur5"),
        (DeviceEntry(name="arm", type="ur50"), "problem", "ur50"),
        (DeviceEntry(name="arm", type="ur5", driver="mojoco"), "problem", "mojoco"),
        (DeviceEntry(name="arm", type="ur5", options={"scene": "nowhere.xml"}), "problem", "nowhere.xml"),
        (DeviceEntry(name="arm", type="ur5", options={"sceen": "scene.xml"}), "problem", "sceen"),
        (DeviceEntry(name="door", type="door", room="lab"), "ok", "door, driver 'mujoco': simulated"),
        (
            DeviceEntry(name="lidar", type="lidar", room="lab", options={"site": "nowhere"}),
            "problem",
            "no site 'nowhere'",
        ),
        (DeviceEntry(name="lidar", type="lidar", room="lab", options={"range": 3}), "problem", "no option 'range'"),
    ],
)
def test_devices_are_built(entry: DeviceEntry, level: str, named: str) -> None:
    (finding,) = devices.device(entry)
    assert finding.level == level
    assert named in finding.message


def test_missing_renderer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    config = AgentConfig(server="http://s", name="n", devices=(ARM,))
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
    assert levels(devices.renderer(config)) == ["ok"]
    monkeypatch.setattr(devices, "_renders", bool)
    assert "Set MUJOCO_GL=osmesa" in text(devices.renderer(config))
    monkeypatch.setattr(devices, "_renders", lambda _: False)
    assert "libosmesa6" in text(devices.renderer(config))


def test_interlocks_without_room_measurements_are_a_problem() -> None:
    rule = InterlockRule(device="other-pir", stream="presence", field="present", equals=True)
    entry = DeviceEntry(name="arm", type="ur5", interlocks=(rule,))
    config = AgentConfig(server="http://s", name="n", devices=(entry,), transport="http")
    assert "problem" in (report := text(devices.room(config)))
    assert "other-pir/presence" in report
    assert levels(devices.room(AgentConfig(server="http://s", name="n", devices=(entry,)))) == []


class _OtherServer(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<html>a router</html>")

    do_POST = do_GET  # noqa: N815 (name required by the library)

    def log_message(self, *_: Any) -> None:
        pass


def test_unreachable_server_and_other_server_are_problems(store: IdentityStore) -> None:
    assert "cannot be reached" in text(cloud.examine(store, AgentConfig.load(store.folder)))
    with HTTPServer(("127.0.0.1", 0), _OtherServer) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        config = AgentConfig(server=f"http://127.0.0.1:{server.server_port}", name="lab", devices=(ARM,))
        report = text(cloud.examine(store, config))
        server.shutdown()
        thread.join()
    assert "is it a Telescope server?" in report


@pytest.mark.parametrize(("offset_ms", "level"), [(0, "ok"), (-2500, "warning"), (5000, "warning")])
def test_clock_offset_is_a_warning(offset_ms: int, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud, "wall_ms", lambda: 1_000_000 + offset_ms)
    monkeypatch.setattr(CloudClock, "now_ms", lambda _: 1_000_000)
    assert levels(cloud._clocks(CloudClock())) == [level]


def test_link_of_a_running_agent_is_not_tested(store: IdentityStore) -> None:
    with store.lock():
        assert "not tested" in text(cloud._link(store, AgentConfig.load(store.folder), PAIRING, CloudClock()))


def test_failed_link_is_reported_with_its_cause(store: IdentityStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud, "_LINK_S", 0.5)
    report = text(cloud._link(store, AgentConfig.load(store.folder), PAIRING, CloudClock()))
    assert "mqtt: no link" in report
    assert "cannot be reached" in report
    assert logging.getLogger("device_agent.transports").handlers == []


class TestReport:
    @pytest.fixture(autouse=True)
    def without_slow_checks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(machine, "scripts", lambda **_: iter(()))
        monkeypatch.setattr(devices, "renderer", lambda _: iter(()))

    def test_exit_code_is_1_for_a_problem_and_0_for_a_warning(
        self, store: IdentityStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert program.main(["doctor", "--home", str(store.folder)]) == 1
        assert "problem  server: " in capsys.readouterr().out
        monkeypatch.setattr(cloud, "examine", lambda *_: iter([warning("server", "slow", "wait")]))
        assert program.main(["doctor", "--home", str(store.folder)]) == 0

    def test_exception_in_a_check_is_a_finding(self, store: IdentityStore, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*_: Any) -> Iterator[Finding]:
            raise RuntimeError("unforeseen")

        monkeypatch.setattr(cloud, "examine", fail)
        assert "RuntimeError: unforeseen" in text(doctor.examine(store))

    @pytest.mark.parametrize("content", ["= 1", 'server = "http://s"', "\x00", '[[devices]]\nname = "a"'])
    def test_invalid_configuration_is_a_finding(self, store: IdentityStore, content: str) -> None:
        (store.folder / "agent.toml").write_text(content)
        assert f"problem: {store.folder / 'agent.toml'}" in text(doctor.examine(store))
