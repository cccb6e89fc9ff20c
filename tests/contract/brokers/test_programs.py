"""The brokers as programs: output, exit codes, restart."""

import json
import os
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.network.brokers import HOST, PATIENCE_S, BrokerKind, start_broker, wait_until
from tests.harness.paths import ROOT


def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run a command that must fail."""
    return subprocess.run(
        [sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


def arguments_for(kind: BrokerKind, home: Path) -> list[str]:
    if kind == "mosquitto":
        return ["infra.mosquitto", "--home", str(home)]
    keys = home / "keys.json"
    from device_agent.protocol.security import signing

    public = signing.generate().public_key()
    keys.write_text(json.dumps({signing.key_id(public): signing.public_text(public)}))
    return ["infra.embedded_broker", "--keys", str(keys)]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_stop_it_cleanly(kind: BrokerKind, tmp_path: Path, number: signal.Signals) -> None:
    with start_broker(kind, tmp_path) as broker:
        with broker.client("tcp") as tcp, broker.client("websocket", transport="websockets") as websocket:
            broker.process.send_signal(number)
            assert broker.process.wait(PATIENCE_S) == 0
            wait_until(tcp.disconnected.is_set, "the end of a connection")
            wait_until(websocket.disconnected.is_set, "the end of a connection")
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((HOST, broker.tcp_port), 1)
        assert "Traceback" not in broker.stderr()


@pytest.mark.parametrize("taken", ["tcp", "websocket"])
def test_a_port_in_use_is_reported_in_one_line(kind: BrokerKind, tmp_path: Path, taken: str) -> None:
    with socket.create_server((HOST, 0)) as other:
        port = str(other.getsockname()[1])
        ports = {"tcp": "0", "websocket": "0", taken: port}
        ended = run(*arguments_for(kind, tmp_path), "--tcp-port", ports["tcp"], "--websocket-port", ports["websocket"])
    assert ended.returncode == 3
    assert ended.stdout == ""
    assert ended.stderr.count("\n") == 1
    assert f"{HOST}:{port}" in ended.stderr
    assert "another port" in ended.stderr


def test_it_listens_on_loopback_only_by_default(kind: BrokerKind, tmp_path: Path) -> None:
    arguments = [*arguments_for(kind, tmp_path), "--tcp-port", "0", "--websocket-port", "0"]
    with subprocess.Popen(
        [sys.executable, "-m", *arguments], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        ports = [int(part.split("=")[1]) for part in process.stdout.readline().split()[1:]]
        listening = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        everywhere = Path("/proc/net/tcp6").read_text()
        process.terminate()
    for port in ports:
        assert [row[1] for row in listening if row[3] == "0A" and row[1].endswith(f":{port:04X}")] == [
            f"0100007F:{port:04X}"
        ]
        assert f":{port:04X} 0000" not in everywhere


def test_credentials_survive_a_restart(kind: BrokerKind, tmp_path: Path) -> None:
    with start_broker(kind, tmp_path) as broker:
        credentials = broker.issue(broker.grant("agent"))
        assert broker.stop() == 0
    with start_broker(kind, tmp_path) as broker, broker.connect("agent", credentials) as agent:
        assert agent.connected.is_set()


def test_it_restarts_on_the_same_ports_after_a_crash(kind: BrokerKind, tmp_path: Path) -> None:
    with start_broker(kind, tmp_path) as broker, broker.client("agent"):
        ports = (broker.tcp_port, broker.websocket_port)
        broker.kill()
        with start_broker(kind, tmp_path, tcp_port=ports[0], websocket_port=ports[1]) as again, again.client("agent"):
            assert (again.tcp_port, again.websocket_port) == ports


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot read the keys"),
        ("", "is not JSON"),
        ("[]", "must be a JSON object"),
        ("{}", "must be a JSON object"),
        ('{"a": "b"}', "not an Ed25519 public key"),
        ('{"a": "11qYAYKxCrfVS_7TyWQHOg7hcvPapiMlrwIaaPcHURo"}', "the id of key 'a' is"),
    ],
)
def test_invalid_keys_are_reported_in_one_line(tmp_path: Path, text: str | None, said: str) -> None:
    keys = tmp_path / "keys.json"
    if text is not None:
        keys.write_text(text)
    ended = run("infra.embedded_broker", "--tcp-port", "0", "--websocket-port", "0", "--keys", str(keys))
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.count("\n") == 1
    assert said in ended.stderr
    assert str(keys) in ended.stderr


def test_an_unusable_folder_is_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ended = run("infra.mosquitto", "--home", str(tmp_path / "file"), "--tcp-port", "0", "--websocket-port", "0")
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.count("\n") == 1
    assert str(tmp_path / "file") in ended.stderr


@pytest.mark.parametrize("host", ["::1", "no.such.host.invalid"])
def test_mosquitto_requires_an_ipv4_address(tmp_path: Path, host: str) -> None:
    ports = ("--tcp-port", "0", "--websocket-port", "0")
    ended = run("infra.mosquitto", "--home", str(tmp_path), "--host", host, *ports)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert host in ended.stderr


def test_mosquittos_secrets_are_readable_by_its_owner_only(tmp_path: Path) -> None:
    with start_broker("mosquitto", tmp_path) as broker:
        password = (tmp_path / "service.password").read_text().strip()
        assert stat.S_IMODE((tmp_path / "service.password").stat().st_mode) == 0o600
        assert stat.S_IMODE((tmp_path / "dynamic-security.json").stat().st_mode) & 0o077 == 0
        broker.issue(broker.grant("agent"))
        with broker.client("other"):
            assert stat.S_IMODE((tmp_path / "dynamic-security.json").stat().st_mode) & 0o077 == 0
        for name in ("mosquitto.conf", "broker.stderr", "dynamic-security.json"):
            assert password not in (tmp_path / name).read_text()


def test_a_missing_password_file_is_reported_in_one_line(tmp_path: Path) -> None:
    with start_broker("mosquitto", tmp_path):
        pass
    (tmp_path / "service.password").unlink()
    ended = run("infra.mosquitto", "--home", str(tmp_path), "--tcp-port", "0", "--websocket-port", "0")
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "service.password" in ended.stderr
    assert (tmp_path / "dynamic-security.json").exists()


def test_killing_the_program_leaves_no_mosquitto_behind(tmp_path: Path) -> None:
    with start_broker("mosquitto", tmp_path) as broker:
        children = Path(f"/proc/{broker.process.pid}/task/{broker.process.pid}/children").read_text().split()
        assert len(children) == 1
        broker.kill()
        wait_until(lambda: not _runs(children[0]), "the end of mosquitto")


def test_an_exit_of_mosquitto_is_reported(tmp_path: Path) -> None:
    with start_broker("mosquitto", tmp_path) as broker:
        child = Path(f"/proc/{broker.process.pid}/task/{broker.process.pid}/children").read_text().split()[0]
        os.kill(int(child), signal.SIGKILL)
        assert broker.process.wait(PATIENCE_S) == 1
        assert "exited with code" in broker.stderr()


def _runs(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
