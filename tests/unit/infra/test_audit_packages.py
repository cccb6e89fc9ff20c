"""The audit of pinned packages reports vulnerabilities and fails without a valid response."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

from tests.harness.paths import ROOT

Responder = Callable[[list[Any]], bytes]


@pytest.fixture
def database() -> Iterator[tuple[str, list[Responder]]]:
    """A fake vulnerability database that calls the first entry of the list."""
    responders: list[Responder] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            queries = json.loads(self.rfile.read(int(self.headers["content-length"])))["queries"]
            body = responders[0](queries)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", responders
    server.shutdown()
    thread.join()
    server.server_close()


def audit(address: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "requirements/audit.py", address]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_every_pinned_package_is_checked(database: tuple[str, list[Responder]]) -> None:
    address, responders = database
    queried: list[Any] = []

    def answer(queries: list[Any]) -> bytes:
        queried.extend(queries)
        vulnerable = {"vulns": [{"id": "PYSEC-1"}]}
        return json.dumps(
            {"results": [vulnerable if each["package"]["name"] == "fastapi" else {} for each in queries]}
        ).encode()

    responders.append(answer)
    result = audit(address)
    assert result.returncode == 1
    assert "fastapi" in result.stderr
    assert "PYSEC-1" in result.stderr
    assert len(queried) > 50
    responders[0] = lambda queries: json.dumps({"results": [{} for _ in queries]}).encode()
    assert audit(address).returncode == 0


def test_an_invalid_response_is_an_error(database: tuple[str, list[Responder]]) -> None:
    address, responders = database
    for answer in (lambda _: b"", lambda _: b"[]", lambda _: b'{"results": []}'):
        responders[:] = [answer]
        result = audit(address)
        assert result.returncode == 2
        assert "NOT CHECKED" in result.stderr
    assert audit("http://127.0.0.1:1").returncode == 2
