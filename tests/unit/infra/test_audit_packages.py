"""The check of pinned packages tells what it was told, and never takes silence for good news."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

from tests.harness.paths import ROOT

Answer = Callable[[list[Any]], bytes]


@pytest.fixture
def database() -> Iterator[tuple[str, list[Answer]]]:
    """Stands where the public database does; answers as the first of the list says."""
    answers: list[Answer] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked = json.loads(self.rfile.read(int(self.headers["content-length"])))["queries"]
            body = answers[0](asked)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", answers
    server.shutdown()
    thread.join()
    server.server_close()


def ask(address: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "requirements/audit.py", address]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_it_asks_about_every_pinned_package_and_names_what_is_known(database: tuple[str, list[Answer]]) -> None:
    address, answers = database
    seen: list[Any] = []

    def answer(asked: list[Any]) -> bytes:
        seen.extend(asked)
        known = {"vulns": [{"id": "PYSEC-1"}]}
        return json.dumps(
            {"results": [known if each["package"]["name"] == "fastapi" else {} for each in asked]}
        ).encode()

    answers.append(answer)
    done = ask(address)
    assert done.returncode == 1
    assert "fastapi" in done.stderr
    assert "PYSEC-1" in done.stderr
    assert len(seen) > 50
    answers[0] = lambda asked: json.dumps({"results": [{} for _ in asked]}).encode()
    assert ask(address).returncode == 0


def test_a_database_that_cannot_be_asked_is_no_good_news(database: tuple[str, list[Answer]]) -> None:
    address, answers = database
    for answer in (lambda _: b"", lambda _: b"[]", lambda _: b'{"results": []}'):
        answers[:] = [answer]
        done = ask(address)
        assert done.returncode == 2
        assert "NOT CHECKED" in done.stderr
    assert ask("http://127.0.0.1:1").returncode == 2
