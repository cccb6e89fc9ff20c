"""The functions as programs: a real server over real sockets, and what its terminal says."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from function_app.entrypoints.http.framework.responses import MAX_BODY
from tests.harness.cloud.cloud import API, problem
from tests.harness.network.brokers import PATIENCE_S, wait_until
from tests.harness.paths import ROOT


def environment(home: Path, port: int) -> dict[str, str]:
    return {**os.environ, "TELESCOPE_HOME": str(home), "TELESCOPE_PORT": str(port), "TELESCOPE_MQTT_PORT": "1"}


def start(home: Path, port: int, *command: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "function_app", *command],
        cwd=ROOT,
        env=environment(home, port),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(home: Path, port: int, *command: str) -> tuple[int, str, str]:
    with start(home, port, *command) as process:
        out, err = process.communicate(timeout=3 * PATIENCE_S)
        return process.returncode, out, err


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


def answers(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("server")


@pytest.fixture(scope="module")
def server(home: Path) -> Iterator[int]:
    """Its port."""
    port = free_port()
    with start(home, port, "serve") as process:
        try:
            wait_until(lambda: answers(port) or process.poll() is not None, "the server")
            assert process.poll() is None
            yield port
        finally:
            process.terminate()
            code = process.wait(PATIENCE_S)
        assert code in {0, -15}
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()


UPGRADE = (
    b"GET /mqtt HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def raw(port: int, request: bytes) -> bytes:
    """Bytes to the server, and all that comes back."""
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as caller:
        caller.sendall(request)
        caller.shutdown(socket.SHUT_WR)
        parts = []
        while part := caller.recv(65_536):
            parts.append(part)
    return b"".join(parts)


def test_a_link_from_the_terminal_signs_in(home: Path, server: int) -> None:
    code, out, err = run(home, server, "sign-in-link", "--account", "anna")
    assert (code, err) == (0, "")
    address, _, link = out.strip().partition("/#sign-in=")
    assert address == f"http://127.0.0.1:{server}"
    answer = httpx.post(f"{address}{API}/auth/sign-in", json={"link": link})
    assert answer.json()["account"]["name"] == "anna"
    assert "server" not in answer.headers
    assert int(answer.headers["x-telescope-time-ms"]) > 0
    token = {"Authorization": f"Bearer {answer.json()['access_token']}"}
    with httpx.Client(base_url=address + API, headers=token) as anna:
        assert anna.get("/devices").json() == {"items": [], "cursor": None}
        problem(anna.get("/nothing"), 404, "http")
        problem(anna.post("/devices"), 405, "http")
        health = anna.get("/health").json()
        assert (health["status"], health["tables"]) == ("degraded", "ok")


def test_too_long_a_body_is_refused_over_a_socket_too(server: int) -> None:
    url = f"http://127.0.0.1:{server}{API}/auth/sign-in"
    body = b"x" * (MAX_BODY + 1)
    problem(httpx.post(url, content=body), 413, "too-large")
    problem(httpx.post(url, content=iter([body[:700_000], body[700_000:]])), 413, "too-large")
    problem(httpx.post(url, content=b" " * MAX_BODY), 422, "invalid")


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
        UPGRADE,
    ],
    ids=["no http", "version", "length", "half", "path", "device", "query", "websocket"],
)
def test_nonsense_does_not_disturb_it(server: int, request_: bytes) -> None:
    said = raw(server, request_)
    assert b" 500 " not in said.partition(b"\r\n")[0]
    assert httpx.get(f"http://127.0.0.1:{server}{API}/health").status_code == 200


def test_a_taken_port_is_one_line_and_exit_code_3(tmp_path: Path, server: int) -> None:
    code, out, err = run(tmp_path, server, "serve")
    assert (code, out) == (3, "")
    assert err == (
        f"telescope-server: 127.0.0.1:{server} cannot be used (Address already in use); "
        "set TELESCOPE_PORT to a free port\n"
    )


@pytest.mark.parametrize("command", ["serve", "sign-in-link"])
def test_a_damaged_file_of_tables_is_one_line_and_left_as_it_is(tmp_path: Path, command: str) -> None:
    damaged = tmp_path / "tables.sqlite"
    damaged.write_bytes(b"no database " * 1000)
    code, out, err = run(tmp_path, free_port(), command)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert err.startswith(f"telescope-server: the tables in {damaged} are damaged")
    assert damaged.read_bytes() == b"no database " * 1000


def test_damaged_keys_are_one_line_and_left_as_they_are(tmp_path: Path) -> None:
    damaged = tmp_path / "keys" / "ring.json"
    damaged.parent.mkdir()
    damaged.write_text("no key")
    code, out, err = run(tmp_path, free_port(), "serve")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert err.startswith(f"telescope-server: the signing keys in {damaged.parent} cannot be used")
    assert damaged.read_text() == "no key"


def test_the_worker_ends_when_it_is_told_to(tmp_path: Path) -> None:
    with start(tmp_path, free_port(), "work") as process:
        wait_until((tmp_path / "tables.sqlite").exists, "the worker")
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "Traceback" not in err


def test_private_files_are_for_their_owner_only(home: Path, server: int) -> None:
    assert server
    assert (home / "keys" / "ring.json").stat().st_mode & 0o077 == 0
    assert (home / "keys").stat().st_mode & 0o077 == 0
    assert (home / "tables.sqlite").stat().st_mode & 0o077 == 0
    assert len(json.loads((home / "keys" / "public.json").read_text())) == 1
