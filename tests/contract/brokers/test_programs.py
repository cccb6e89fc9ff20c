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

from device_agent.protocol.security import signing
from tests.harness.network.brokers import HOST, PATIENCE_S, BrokerKind, start_broker, wait_until
from tests.harness.network.child_processes import child_processes
from tests.harness.paths import ROOT

FREE_PORTS = ("--tcp-port", "0", "--websocket-port", "0")
INVALID = 2
PORT_IN_USE = 3


def assert_fails(expected: int, *arguments: str) -> str:
    """The one line that a program writes before it ends with this exit code."""
    ended = subprocess.run(
        [sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (expected, "", 1), ended.stderr
    return ended.stderr


def arguments_for(kind: BrokerKind, home: Path) -> list[str]:
    if kind == "mosquitto":
        return ["infra.mosquitto", "--home", str(home)]
    keys = home / "keys.json"
    public = signing.generate().public_key()
    keys.write_text(json.dumps({signing.key_id(public): signing.public_text(public)}))
    return ["infra.embedded_broker", "--keys", str(keys)]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_stop_it_cleanly_and_credentials_survive_the_restart(
    kind: BrokerKind, tmp_path: Path, number: signal.Signals
) -> None:
    with start_broker(kind, tmp_path) as broker:
        credentials = broker.issue(broker.grant("agent"))
        with broker.client("tcp") as tcp, broker.client("websocket", transport="websockets") as websocket:
            broker.process.send_signal(number)
            assert broker.process.wait(PATIENCE_S) == 0
            assert tcp.ended()
            assert websocket.ended()
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((HOST, broker.tcp_port), 1)
        assert "Traceback" not in broker.stderr()
    if number == signal.SIGTERM:
        with start_broker(kind, tmp_path) as broker:
            assert broker.accepts("agent", credentials)


def test_it_restarts_on_the_same_ports_after_a_crash_and_keeps_revocations(kind: BrokerKind, tmp_path: Path) -> None:
    with start_broker(kind, tmp_path) as broker, broker.client("other"):
        revoked, valid = broker.issue(broker.grant("revoked")), broker.issue(broker.grant("valid"))
        broker.revoke(client_id="revoked")
        ports = (broker.tcp_port, broker.websocket_port)
        broker.kill()
        with start_broker(kind, tmp_path, tcp_port=ports[0], websocket_port=ports[1]) as again:
            assert (again.tcp_port, again.websocket_port) == ports
            assert not again.accepts("revoked", revoked)
            assert again.accepts("valid", valid)


@pytest.mark.parametrize("taken", ["--tcp-port", "--websocket-port"])
def test_a_port_in_use_is_reported_in_one_line(kind: BrokerKind, tmp_path: Path, taken: str) -> None:
    with socket.create_server((HOST, 0)) as other:
        port = str(other.getsockname()[1])
        line = assert_fails(PORT_IN_USE, *arguments_for(kind, tmp_path), *FREE_PORTS, taken, port)
    assert f"{HOST}:{port}" in line
    assert "another port" in line


def test_it_listens_on_loopback_only_by_default(kind: BrokerKind, tmp_path: Path) -> None:
    arguments = [*arguments_for(kind, tmp_path), *FREE_PORTS]
    with subprocess.Popen(
        [sys.executable, "-m", *arguments], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        ports = [int(part.split("=")[1]) for part in process.stdout.readline().split()[1:]]
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        ipv6 = Path("/proc/net/tcp6").read_text()
        process.terminate()
    for port in ports:
        listening = [row[1] for row in rows if row[3] == "0A" and row[1].endswith(f":{port:04X}")]
        assert listening == [f"0100007F:{port:04X}"]
        assert f":{port:04X} 0000" not in ipv6


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "cannot read the keys"),
        ("", "is not JSON"),
        ("[]", "must be a JSON object"),
        ("{}", "must be a JSON object"),
        ('{"a": "b"}', "not an Ed25519 public key"),
        ('{"a": "11qYAYKxCrfVS_7TyWQHOg7hcvPapiMlrwIaaPcHURo"}', "the id of key 'a' is"),
    ],
)
def test_invalid_keys_of_the_embedded_broker_are_reported(tmp_path: Path, text: str | None, expected: str) -> None:
    keys = tmp_path / "keys.json"
    if text is not None:
        keys.write_text(text)
    line = assert_fails(INVALID, "infra.embedded_broker", *FREE_PORTS, "--keys", str(keys))
    assert expected in line
    assert str(keys) in line


# ---------------------------------------------------------------- mosquitto


def test_invalid_arguments_of_mosquitto_are_reported(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert str(file) in assert_fails(INVALID, "infra.mosquitto", "--home", str(file), *FREE_PORTS)
    for host in ("::1", "no.such.host.invalid"):  # it needs an IPv4 address
        arguments = ("--home", str(tmp_path), "--host", host, *FREE_PORTS)
        assert host in assert_fails(INVALID, "infra.mosquitto", *arguments)


def test_mosquittos_secrets_are_readable_by_its_owner_only(tmp_path: Path) -> None:
    password, security = tmp_path / "service.password", tmp_path / "dynamic-security.json"
    with start_broker("mosquitto", tmp_path) as broker:
        assert stat.S_IMODE(password.stat().st_mode) == 0o600
        for _ in range(2):
            assert stat.S_IMODE(security.stat().st_mode) & 0o077 == 0
            broker.client("agent").close()
        text = password.read_text().strip()
        for name in ("mosquitto.conf", "broker.stderr", "dynamic-security.json"):
            assert text not in (tmp_path / name).read_text()
    password.unlink()
    assert password.name in assert_fails(INVALID, "infra.mosquitto", "--home", str(tmp_path), *FREE_PORTS)
    assert security.exists()


@pytest.mark.parametrize("name", ["mosquitto", "haproxy"])
def test_program_and_servers_end_together(tmp_path: Path, name: str) -> None:
    with start_broker("mosquitto", tmp_path) as broker:
        servers = child_processes(broker.process.pid)
        assert set(servers) == {"mosquitto", "haproxy"}
        broker.kill()
        wait_until(lambda: not any(map(_runs, servers.values())), "the end of the servers")
    with start_broker("mosquitto", tmp_path) as broker:
        servers = child_processes(broker.process.pid)
        os.kill(servers[name], signal.SIGKILL)
        assert broker.process.wait(PATIENCE_S) == 1
        assert f"{name} exited with code -9" in broker.stderr()
        assert not any(map(_runs, servers.values()))


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
