"""The server on one machine: a real process over real sockets, its commands, and their output in a terminal."""

import asyncio
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from function_app.entrypoints.hosts.uvicorn import listen
from function_app.entrypoints.http.framework.responses import MAX_BODY
from tests.conftest import Emulators
from tests.harness.cloud.cloud import API, problem
from tests.harness.network.brokers import PATIENCE_S, wait_until
from tests.harness.network.ports import free_port
from tests.harness.paths import ROOT
from tests.harness.stores.aws import use_credentials
from tests.harness.stores.emulators import empty_store
from tests.harness.terminal import RunCommand, command_runner

LOOPBACK = "127.0.0.1"


def start(home: Path, port: int, command: str) -> "subprocess.Popen[str]":
    variables = {"TELESCOPE_HOME": str(home), "TELESCOPE_PORT": str(port), "TELESCOPE_MQTT_PORT": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "function_app", command],
        cwd=ROOT,
        env={**os.environ, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def accepts_connections(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex((LOOPBACK, port)) == 0


@pytest.fixture
def run_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RunCommand:
    return command_runner(monkeypatch, capsys)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("server")


@pytest.fixture(scope="module")
def server(home: Path) -> Iterator[int]:
    """Run the server; yields its port."""
    port = free_port()
    with start(home, port, "serve") as process:
        try:
            wait_until(lambda: accepts_connections(port) or process.poll() is not None, "the server")
            assert process.poll() is None
            yield port
        finally:
            process.terminate()
            code = process.wait(PATIENCE_S)
        assert code in {0, -15}
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()


def raw(port: int, request: bytes) -> bytes:
    """Send bytes to the server; returns the whole response."""
    with socket.create_connection((LOOPBACK, port), timeout=PATIENCE_S) as caller:
        caller.sendall(request)
        caller.shutdown(socket.SHUT_WR)
        return b"".join(iter(lambda: caller.recv(65_536), b""))


def test_a_link_from_the_terminal_signs_in(home: Path, server: int, run_command: RunCommand) -> None:
    arguments = ("sign-in-link", "--account", "anna")
    ended = run_command(*arguments, TELESCOPE_HOME=str(home), TELESCOPE_PORT=str(server))
    assert (ended.code, ended.err) == (0, "")
    address, _, link = ended.out.strip().partition("/#sign-in=")
    assert address == f"http://{LOOPBACK}:{server}"
    response = httpx.post(f"{address}{API}/auth/sign-in", json={"link": link})
    assert response.json()["account"]["name"] == "anna"
    assert "server" not in response.headers
    token = {"Authorization": f"Bearer {response.json()['access_token']}"}
    with httpx.Client(base_url=address + API, headers=token) as anna:
        assert anna.get("/devices").json() == {"items": [], "cursor": None}
        health = anna.get("/health").json()
        assert (health["status"], health["tables"]) == ("degraded", "ok")
    for name in ("keys", "keys/ring.json", "tables.sqlite"):
        assert (home / name).stat().st_mode & 0o077 == 0, name
    assert len(json.loads((home / "keys" / "public.json").read_text())) == 1


def test_a_body_of_unknown_length_is_limited(server: int) -> None:
    url = f"http://{LOOPBACK}:{server}{API}/auth/sign-in"
    parts = [bytes(MAX_BODY), b"x"]
    problem(httpx.post(url, content=iter(parts)), 413, "too-large")
    problem(httpx.post(url, content=iter(parts[:1])), 422, "invalid")


@pytest.mark.parametrize(
    "request_",
    [
        b"nonsense\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"POST /api/v1/auth/sign-in HTTP/1.1\r\nHost: x\r\nContent-Length: x\r\n\r\n",
        b"POST /api/v1/auth/sign-in HTTP/1.1\r\nHost: x\r\nContent-Length: 10\r\n\r\n{",
        b"GET /\xff\xfe HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
        b"GET /api/v1/devices/%ff%00%ed%a0%80 HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
        b"GET /api/v1/devices?cursor=%ff%00 HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer \xff\r\n\r\n",
        (
            b"GET /mqtt HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        ),
    ],
    ids=["not HTTP", "version", "length", "half", "path", "device", "query", "websocket"],
)
def test_an_invalid_request_does_not_disturb_the_server(server: int, request_: bytes) -> None:
    assert b" 500 " not in raw(server, request_).partition(b"\r\n")[0]
    assert httpx.get(f"http://{LOOPBACK}:{server}{API}/health").status_code == 200


@pytest.mark.parametrize("path", [f"{API}/health", "/"])
def test_a_request_under_the_name_of_another_site_is_rejected(server: int, path: str) -> None:
    """Otherwise a page of another site reaches the API after it has changed its address to that of this server."""
    url = f"http://{LOOPBACK}:{server}{path}"
    rejected = problem(httpx.get(url, headers={"Host": f"attacker.example:{server}"}), 400, "host")
    assert "TELESCOPE_ALLOWED_HOSTS" in rejected["detail"]
    assert httpx.get(url, headers={"Host": "localhost"}).status_code != 400


def test_responses_are_sent_without_delay_on_every_accepted_connection() -> None:
    """Nagle's algorithm and the client's delayed acknowledgement together cost 40 ms per response."""

    async def nodelay_of_accepted() -> int:
        option: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            accepted = writer.get_extra_info("socket")
            option.set_result(accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(serve, sock=listen(LOOPBACK, 0)) as server:
            _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            try:
                return await asyncio.wait_for(option, PATIENCE_S)
            finally:
                writer.close()
                await writer.wait_closed()

    assert asyncio.run(nodelay_of_accepted())


# ---------------------------------------------------------------- errors in the terminal


def test_a_port_in_use_is_reported_in_one_line_with_exit_code_3(tmp_path: Path, server: int) -> None:
    with start(tmp_path, server, "serve") as process:
        out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out) == (3, "")
    assert err == (
        f"telescope-server: {LOOPBACK}:{server} cannot be used (Address already in use); "
        "set TELESCOPE_PORT to a free port\n"
    )


@pytest.mark.parametrize(
    ("command", "file", "expected"),
    [
        ("serve", "tables.sqlite", "the tables in {file} are damaged"),
        ("sign-in-link", "tables.sqlite", "the tables in {file} are damaged"),
        ("serve", "keys/ring.json", "the signing keys in {file.parent} cannot be used"),
    ],
)
def test_a_damaged_file_is_reported_in_one_line_and_unchanged(
    tmp_path: Path, run_command: RunCommand, command: str, file: str, expected: str
) -> None:
    damaged = tmp_path / file
    damaged.parent.mkdir(exist_ok=True)
    damaged.write_bytes(b"no data " * 1000)
    ended = run_command(command, TELESCOPE_HOME=str(tmp_path), TELESCOPE_PORT=str(free_port()))
    assert (ended.code, ended.out, ended.err.count("\n")) == (1, "", 1)
    assert ended.err.startswith("telescope-server: " + expected.format(file=damaged))
    assert damaged.read_bytes() == b"no data " * 1000


def test_a_missing_table_is_reported_in_one_line_and_prepare_creates_it(
    tmp_path: Path, emulators: Emulators, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_credentials(monkeypatch)
    store = {"TELESCOPE_HOME": str(tmp_path), **empty_store("aws", emulators("aws"))}
    for command in ("serve", "work", "sign-in-link"):
        ended = run_command(command, environment=store)
        assert (ended.code, ended.out, ended.err.count("\n")) == (1, "", 1), ended.err
        assert f"the DynamoDB table '{store['TELESCOPE_AWS_TABLE']}' in eu-west-1" in ended.err
        assert "`python -m function_app prepare`" in ended.err
    assert [run_command("prepare", environment=store) for _ in range(2)] == [(0, "", "")] * 2
    ended = run_command("sign-in-link", environment=store)
    assert (ended.code, ended.err) == (0, "")
    assert "#sign-in=" in ended.out


def test_the_worker_ends_on_sigterm(tmp_path: Path) -> None:
    with start(tmp_path, free_port(), "work") as process:
        wait_until((tmp_path / "tables.sqlite").exists, "the worker")
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "Traceback" not in err
