"""The control socket: private, strict, and robust against other programs of the machine."""

import os
import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.cli.local_control import client, messages, server
from device_agent.cli.local_control.messages import ControlRequest, SocketAddress
from device_agent.cli.local_control.server import ControlServer
from device_agent.config.errors import ConfigError
from device_agent.config.release import VERSION
from device_agent.runtime.restart_permission import PERMISSION_S, RestartPermission
from tests.harness.agent.device_harness import eventually


class Fixture:
    """A control server with a device at rest."""

    def __init__(self, folder: Path) -> None:
        self.reason = ""
        self.suspended = False
        self.now_s = 0.0
        self.restarts = threading.Event()
        self.permission = RestartPermission(self, clock_s=lambda: self.now_s)
        self.server = ControlServer(folder, self.permission, linked=lambda: True, restart=self.restarts.set)
        self.folder = folder

    def suspend(self, _why: str) -> str:
        self.suspended = not self.reason
        return self.reason

    def resume(self) -> None:
        self.suspended = False

    def rejects_motion(self) -> bool:
        return self.suspended

    def call(self, kind: str, token: str = "") -> messages.ControlResponse:
        answer = client.call(self.folder, ControlRequest(kind=kind, token=token))  # type: ignore[arg-type]
        assert answer is not None
        return answer

    def send(self, payload: bytes) -> bytes:
        with socket.socket(socket.AF_UNIX) as connection, SocketAddress(self.folder) as address:
            connection.connect(address)
            connection.sendall(payload)
            return messages.receive_line(connection)


@pytest.fixture
def fixture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fixture]:
    monkeypatch.setattr(server, "_POLL_S", 0.02)
    folder = tmp_path / ("long" * 30)  # longer than the path of a Unix socket
    folder.mkdir()
    fixture = Fixture(folder)
    fixture.server.start()
    yield fixture
    fixture.server.stop()
    fixture.server.stop()
    assert not (folder / messages.SOCKET_FILE).exists()


def test_only_the_owner_can_connect(fixture: Fixture) -> None:
    assert stat.S_IMODE((fixture.folder / messages.SOCKET_FILE).stat().st_mode) == 0o600
    answer = fixture.call("status")
    assert (answer.ok, answer.version, answer.linked) == (True, VERSION, True)


def test_a_permission_is_given_taken_back_and_used(fixture: Fixture) -> None:
    fixture.reason = "arm: it moves"
    assert fixture.call("request-restart").reason == "arm: it moves"
    fixture.reason = ""
    token = fixture.call("request-restart").token
    assert fixture.rejects_motion()
    assert fixture.call("cancel-restart", token).ok
    assert not fixture.rejects_motion()
    assert fixture.call("confirm-restart", token).reason == "the permission has expired"
    assert not fixture.restarts.is_set()
    assert fixture.call("confirm-restart", fixture.call("request-restart").token).ok
    assert fixture.restarts.wait(20)
    assert fixture.rejects_motion()


def test_a_permission_expires_without_any_further_request(fixture: Fixture) -> None:
    assert fixture.call("request-restart").ok
    fixture.now_s = PERMISSION_S
    eventually(lambda: not fixture.rejects_motion())


@pytest.mark.parametrize("payload", [b"\n", b"{}\n", b'{"kind":"stop"}\n', b"\xff\n", b"[" * 5000, b"x" * 9000])
def test_a_malformed_request_is_rejected_and_changes_nothing(fixture: Fixture, payload: bytes) -> None:
    assert b"malformed request" in fixture.send(payload)
    assert fixture.call("status").ok
    assert not fixture.rejects_motion()


def test_a_silent_client_delays_others_only_for_a_short_time(fixture: Fixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "TIMEOUT_S", 0.1)
    with socket.socket(socket.AF_UNIX) as silent, SocketAddress(fixture.folder) as address:
        silent.connect(address)
        assert fixture.call("status").ok


def test_the_socket_of_a_killed_agent_is_replaced(fixture: Fixture) -> None:
    folder = fixture.folder.parent / "killed"
    folder.mkdir()
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(folder / messages.SOCKET_FILE))
    assert client.call(folder, ControlRequest(kind="status")) is None
    second = ControlServer(folder, fixture.permission, linked=lambda: False, restart=fixture.restarts.set)
    second.start()
    try:
        answer = client.call(folder, ControlRequest(kind="status"))
        assert answer is not None
        assert not answer.linked
    finally:
        second.stop()


def test_an_agent_that_does_not_answer_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "TIMEOUT_S", 0.05)
    with socket.socket(socket.AF_UNIX) as hanging:
        with SocketAddress(tmp_path) as address:
            hanging.bind(address)
        hanging.listen()
        with pytest.raises(ConfigError, match="runs but does not respond"):
            client.call(tmp_path, ControlRequest(kind="status"))


def test_the_agent_runs_without_a_socket_where_none_is_possible(
    fixture: Fixture, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "taken"
    (folder / messages.SOCKET_FILE / "x").mkdir(parents=True)
    monkey = ControlServer(folder / "missing", fixture.permission, linked=lambda: False, restart=os.abort)
    monkey.start()
    monkey.stop()
    assert "stop the agent before an update" in caplog.text
