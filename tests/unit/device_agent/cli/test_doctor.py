"""The doctor: each thing that can be wrong is named, with what to do about it, and nothing ends in a traceback."""

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
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.clock import CloudClock

ARM = DeviceEntry(name="arm", type="ur5")
SPACE = namedtuple("SPACE", "total used free")  # noqa: PYI024 (as shutil gives it)


@pytest.fixture
def store(tmp_path: Path) -> IdentityStore:
    """Enrolled, not paired; its server is not there."""
    store = IdentityStore(tmp_path / "agent")
    store.private_key(create=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        server = f"http://127.0.0.1:{free.getsockname()[1]}"
    AgentConfig(server=server, name="lab", devices=(ARM,)).save(store.folder)
    return store


def levels(found: Iterator[Finding]) -> list[str]:
    every = list(found)
    for each in every:
        assert each.level == "ok" or each.advice, f"{each}: and what to do?"
        assert "Traceback" not in each.message
    return [each.level for each in every]


def text(found: Iterator[Finding]) -> str:
    return " ".join(f"{each.level}: {each.message} → {each.advice}" for each in found)


class TestMachine:
    def test_root_is_warned_of(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(os, "geteuid", lambda: 0)
        assert levels(machine.user()) == ["warning"]
        monkeypatch.setattr(os, "geteuid", lambda: 1000)
        assert levels(machine.user()) == ["ok"]
        monkeypatch.delattr(os, "geteuid")
        assert levels(machine.user()) == ["ok"]

    def test_a_folder_for_the_agent_alone_is_well(self, store: IdentityStore) -> None:
        assert levels(machine.folder(store)) == ["ok"]

    def test_no_folder_and_no_agent_in_it_are_problems(self, tmp_path: Path) -> None:
        assert "does not exist" in text(machine.folder(IdentityStore(tmp_path / "none")))
        assert "holds no agent" in text(machine.folder(IdentityStore(tmp_path)))

    def test_a_key_that_others_can_read_is_a_problem_and_all_else_a_warning(self, store: IdentityStore) -> None:
        store.folder.chmod(0o755)
        (store.folder / "agent.toml").chmod(0o640)
        assert levels(machine.folder(store)) == ["warning", "warning"]
        (store.folder / "identity.pem").chmod(0o644)
        said = text(machine.folder(store))
        assert "problem: others on this machine can read" in said
        assert f"chmod 600 {store.folder / 'identity.pem'}" in said

    def test_a_full_disk_is_a_problem_before_the_journal_fails(
        self, store: IdentityStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        found = []
        for free in (10**6, 2 * 10**8, 10**10):
            monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: SPACE(0, 0, free))
            found += levels(machine.disk(store))
        assert found == ["problem", "warning", "ok"]

    def test_a_damaged_journal_is_named(self, store: IdentityStore) -> None:
        store.journal.write_bytes(b"not a database, and long enough to be taken for one" * 30)
        assert f"problem: {store.journal} is damaged" in text(machine.disk(store))
        store.journal.unlink()
        with sqlite3.connect(store.journal) as journal:
            journal.execute("CREATE TABLE commands (id TEXT)")
        journal.close()
        assert "journal.db is whole" in text(machine.disk(store))

    def test_scripts_that_cannot_be_locked_in_are_told_of(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sys, "platform", "darwin")
        assert "scripts run on Linux only" in text(machine.scripts(trusted=False))
        assert "with this agent's rights" in text(machine.scripts(trusted=True))
        assert levels(machine.python()) == ["warning"]

    def test_a_machine_without_a_voice_is_told_how_to_get_one(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        assert levels(machine.voice()) == ["ok"]
        monkeypatch.setenv("PATH", str(tmp_path))
        assert "apt-get install espeak-ng" in text(machine.voice())


class TestRobots:
    def test_a_device_that_is_well_is_built(self) -> None:
        assert levels(devices.device(ARM)) == ["ok"]

    @pytest.mark.parametrize(
        ("entry", "named"),
        [
            (DeviceEntry(name="arm", type="ur50"), "ur50"),
            (DeviceEntry(name="arm", type="ur5", driver="mojoco"), "mojoco"),
            (DeviceEntry(name="arm", type="ur5", options={"scene": "nowhere.xml"}), "nowhere.xml"),
            (DeviceEntry(name="arm", type="ur5", options={"sceen": "scene.xml"}), "sceen"),
        ],
        ids=["type", "driver", "scene", "option"],
    )
    def test_a_device_that_cannot_be_built_is_a_problem(self, entry: DeviceEntry, named: str) -> None:
        said = text(devices.device(entry))
        assert said.startswith("problem")
        assert named in said

    def test_pictures_need_a_renderer(self, monkeypatch: pytest.MonkeyPatch) -> None:
        told = AgentConfig(server="http://s", name="n", devices=(ARM,))
        monkeypatch.setenv("MUJOCO_GL", "osmesa")
        monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
        assert levels(devices.renderer(told)) == ["ok"]
        monkeypatch.setattr(devices, "_renders", bool)
        assert "Set MUJOCO_GL=osmesa" in text(devices.renderer(told))
        monkeypatch.setattr(devices, "_renders", lambda _: False)
        assert "libosmesa6" in text(devices.renderer(told))

    def test_a_room_that_this_transport_cannot_hear_is_a_problem(self) -> None:
        rule = InterlockRule(device="other-pir", stream="presence", field="present", equals=True)
        entry = DeviceEntry(name="arm", type="ur5", interlocks=(rule,))
        told = AgentConfig(server="http://s", name="n", devices=(entry,), transport="http")
        assert "other-pir/presence stays silent" in text(devices.room(told))
        assert levels(devices.room(AgentConfig(server="http://s", name="n", devices=(entry,)))) == []


class TestCloud:
    def test_a_server_that_is_not_there_is_a_problem(self, store: IdentityStore) -> None:
        said = text(cloud.look(store, AgentConfig.load(store.folder)))
        assert "problem" in said
        assert "cannot be reached" in said

    def test_something_else_that_answers_is_a_problem(self, store: IdentityStore) -> None:
        with HTTPServer(("127.0.0.1", 0), _SomethingElse) as server:
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            address = f"http://127.0.0.1:{server.server_port}"
            told = AgentConfig(server=address, name="lab", devices=(ARM,))
            said = text(cloud.look(store, told))
            server.shutdown()
            thread.join()
        assert "is it a Telescope server?" in said

    @pytest.mark.parametrize(("off_ms", "level"), [(0, "ok"), (-2500, "warning"), (5000, "warning")])
    def test_a_clock_that_is_off_is_warned_of(self, off_ms: int, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
        clock = CloudClock()
        clock.observe(server_ms=1_000_000, sent_tick_ms=500, received_tick_ms=501)
        now_ms = clock.now_ms()
        assert now_ms is not None
        monkeypatch.setattr(cloud, "wall_ms", lambda: now_ms + off_ms)
        monkeypatch.setattr(CloudClock, "now_ms", lambda _: now_ms)
        assert levels(cloud._clocks(clock)) == [level]

    def test_an_agent_that_runs_is_not_disturbed(self, store: IdentityStore) -> None:
        pairing = Pairing(agent="a", space="s", account="anna", keys={})
        with store.lock():
            said = text(cloud._link(store, AgentConfig.load(store.folder), pairing, CloudClock()))
        assert "not disturbed" in said

    def test_a_link_that_does_not_come_says_why(self, store: IdentityStore, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(cloud, "_LINK_S", 0.5)
        pairing = Pairing(agent="a", space="s", account="anna", keys={})
        said = text(cloud._link(store, AgentConfig.load(store.folder), pairing, CloudClock()))
        assert "mqtt: no link" in said
        assert "cannot be reached" in said
        assert logging.getLogger("device_agent.transports").handlers == []


class TestReport:
    @pytest.fixture(autouse=True)
    def quick(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(machine, "scripts", lambda **_: iter(()))
        monkeypatch.setattr(devices, "renderer", lambda _: iter(()))

    def test_a_problem_ends_with_one_and_a_warning_with_zero(
        self, store: IdentityStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert program.main(["doctor", "--home", str(store.folder)]) == 1
        assert "problem  server: " in capsys.readouterr().out
        monkeypatch.setattr(cloud, "look", lambda *_: iter([warning("server", "slow", "wait")]))
        assert program.main(["doctor", "--home", str(store.folder)]) == 0

    def test_a_check_that_fails_itself_is_a_finding(
        self, store: IdentityStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def broken(*_: Any) -> Iterator[Finding]:
            raise RuntimeError("what nobody thought of")

        monkeypatch.setattr(cloud, "look", broken)
        assert "RuntimeError: what nobody thought of" in text(doctor.examine(store))

    @pytest.mark.parametrize("content", ["= 1", 'server = "http://s"', "\x00", '[[devices]]\nname = "a"'])
    def test_whatever_stands_in_the_configuration_is_a_finding(self, store: IdentityStore, content: str) -> None:
        (store.folder / "agent.toml").write_text(content)
        assert f"problem: {store.folder / 'agent.toml'}" in text(doctor.examine(store))


class TestSoleUse:
    def test_two_processes_cannot_run_one_robot(self, store: IdentityStore) -> None:
        with store.lock(), pytest.raises(ConfigError, match="already"), store.lock():
            pytest.fail("two hold it")
        with store.lock():
            pass

    def test_a_folder_without_an_agent_cannot_be_run(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="enroll"), IdentityStore(tmp_path / "none").lock():
            pytest.fail("there is nothing to hold")


class _SomethingElse(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<html>a router</html>")

    do_POST = do_GET  # noqa: N815 (as the library asks)

    def log_message(self, *_: Any) -> None:
        pass
