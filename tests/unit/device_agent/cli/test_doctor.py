"""``doctor`` names each problem with its remedy and never fails with a traceback."""

import contextlib
import logging
import os
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from msgspec.structs import replace

from device_agent import __main__ as program
from device_agent.cli import doctor
from device_agent.cli.doctor import cloud, devices, machine
from device_agent.cli.doctor.finding import Finding, warning
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.clock import CloudClock
from tests.harness.network.http_server import QuietHandler, serve
from tests.harness.network.ports import free_port

ARM = DeviceEntry(name="arm", type="ur5")
LIDAR = DeviceEntry(name="lidar", type="lidar", room="lab")
PAIRING = Pairing(agent="a", space="s", account="anna", keys={})


@pytest.fixture
def store(tmp_path: Path) -> IdentityStore:
    """Enrolled but not paired; the server is unreachable."""
    store = IdentityStore(tmp_path / "agent")
    store.private_key(create=True)
    server = f"http://127.0.0.1:{free_port()}"
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
    monkeypatch.setattr(os, "geteuid", lambda: uid)
    if uid is None:
        monkeypatch.delattr(os, "geteuid")
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
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    assert levels(machine.disk(store)) == [level]


def test_damaged_journal_is_a_problem(store: IdentityStore) -> None:
    store.journal.write_bytes(b"not a database, and long enough to be mistaken for one" * 30)
    assert f"problem: {store.journal} is damaged" in text(machine.disk(store))
    store.journal.unlink()
    with contextlib.closing(sqlite3.connect(store.journal)) as journal:
        journal.execute("CREATE TABLE commands (id TEXT)")
    assert "journal.db is intact" in text(machine.disk(store))


def test_missing_features_of_the_machine_are_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert levels(machine.voice()) == ["ok"]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "apt-get install espeak-ng" in text(machine.voice())
    monkeypatch.setattr(sys, "platform", "darwin")
    assert "scripts run on Linux only" in text(machine.scripts(allow_unconfined=False))
    assert "with this agent's rights" in text(machine.scripts(allow_unconfined=True))
    assert levels(machine.python()) == ["warning"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("entry", "level", "named"),
    [
        (ARM, "ok", "ur5"),
        (replace(ARM, type="ur50"), "problem", "ur50"),
        (replace(ARM, driver="mojoco"), "problem", "mojoco"),
        (replace(ARM, options={"scene": "nowhere.xml"}), "problem", "nowhere.xml"),
        (replace(ARM, options={"sceen": "scene.xml"}), "problem", "sceen"),
        (DeviceEntry(name="door", type="door", room="lab"), "ok", "door, driver 'mujoco': simulated"),
        (replace(LIDAR, options={"site": "nowhere"}), "problem", "no site 'nowhere'"),
        (replace(LIDAR, options={"range": 3}), "problem", "no option 'range'"),
    ],
)
def test_devices_are_built(entry: DeviceEntry, level: str, named: str) -> None:
    (finding,) = devices.device(entry, Path("/nowhere"))
    assert finding.level == level
    assert named in finding.message


@pytest.mark.slow
def test_renderer_is_named_and_a_missing_one_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    config = AgentConfig(server="http://s", name="n", devices=(ARM,))
    assert "OSMesa (" in text(devices.renderer(config))
    monkeypatch.setattr(devices, "_renders", str)
    assert "libosmesa6" in text(devices.renderer(config))
    monkeypatch.setenv("MUJOCO_GL", "egl")
    assert "Unset MUJOCO_GL (now egl)" in text(devices.renderer(config))


def test_interlocks_without_room_measurements_are_a_problem() -> None:
    rule = InterlockRule(device="other-pir", stream="presence", field="present", equals=True)
    config = AgentConfig(server="http://s", name="n", devices=(replace(ARM, interlocks=(rule,)),))
    assert levels(devices.room(config)) == []
    report = text(devices.room(replace(config, transport="http")))
    assert "problem" in report
    assert "other-pir/presence" in report


class OtherServer(QuietHandler):
    def handle_any(self) -> None:
        self.respond(200, [], b"<html>a router</html>")


def test_unreachable_server_and_other_server_are_problems(store: IdentityStore) -> None:
    config = AgentConfig.load(store.folder)
    assert "cannot be reached" in text(cloud.examine(store, config))
    with serve(OtherServer) as url:
        assert "is it a Telescope server?" in text(cloud.examine(store, replace(config, server=url)))


@pytest.mark.parametrize(("offset_ms", "level"), [(0, "ok"), (-2500, "warning"), (5000, "warning")])
def test_clock_offset_is_a_warning(offset_ms: int, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud, "wall_ms", lambda: 1_000_000 + offset_ms)
    monkeypatch.setattr(CloudClock, "now_ms", lambda _: 1_000_000)
    assert levels(cloud._clocks(CloudClock())) == [level]


def test_link_of_a_running_agent_is_not_tested(store: IdentityStore) -> None:
    with store.lock():
        assert "not tested" in text(cloud._link(store, AgentConfig.load(store.folder), PAIRING, CloudClock()))


@pytest.mark.slow
def test_failed_link_is_reported_with_its_cause(store: IdentityStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud, "_LINK_S", 0.5)
    report = text(cloud._link(store, AgentConfig.load(store.folder), PAIRING, CloudClock()))
    assert "mqtt: no link" in report
    assert "cannot be reached" in report
    assert logging.getLogger("device_agent.transports").handlers == []


@pytest.fixture
def without_slow_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "scripts", lambda **_: iter(()))
    monkeypatch.setattr(devices, "renderer", lambda _: iter(()))


@pytest.mark.slow
@pytest.mark.usefixtures("without_slow_checks")
def test_exit_code_is_1_for_a_problem_and_0_for_a_warning(
    store: IdentityStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.main(["doctor", "--home", str(store.folder)]) == 1
    assert "problem  server: " in capsys.readouterr().out
    monkeypatch.setattr(cloud, "examine", lambda *_: iter([warning("server", "slow", "wait")]))
    assert program.main(["doctor", "--home", str(store.folder)]) == 0


@pytest.mark.usefixtures("without_slow_checks")
def test_exception_in_a_check_is_a_finding(store: IdentityStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud, "examine", Mock(side_effect=RuntimeError("unforeseen")))
    assert "RuntimeError: unforeseen" in text(doctor.examine(store))


@pytest.mark.usefixtures("without_slow_checks")
@pytest.mark.parametrize("content", ["= 1", 'server = "http://s"', "\x00", '[[devices]]\nname = "a"'])
def test_invalid_configuration_is_a_finding(store: IdentityStore, content: str) -> None:
    (store.folder / "agent.toml").write_text(content)
    assert f"problem: {store.folder / 'agent.toml'}" in text(doctor.examine(store))
