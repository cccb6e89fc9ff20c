"""The audit of pinned packages reports vulnerabilities and fails without a valid response."""

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from tests.harness.network.http_server import QuietHandler, serve
from tests.harness.paths import ROOT


class Database:
    """A vulnerability database with one vulnerable package."""

    address = ""
    vulnerable = ""
    invalid_body: bytes | None = None
    queries: tuple[Any, ...] = ()

    def body(self, queries: list[Any]) -> bytes:
        self.queries = tuple(queries)
        names = [query["package"]["name"] for query in queries]
        results = [{"vulns": [{"id": "PYSEC-1"}]} if name == self.vulnerable else {} for name in names]
        return json.dumps({"results": results}).encode() if self.invalid_body is None else self.invalid_body

    def audit(self) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "requirements/audit.py", self.address]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture
def database() -> Iterator[Database]:
    database = Database()

    class Handler(QuietHandler):
        def handle_any(self) -> None:
            queries = json.loads(self.rfile.read(int(self.headers["content-length"])))["queries"]
            self.respond(200, [], database.body(queries))

    with serve(Handler) as database.address:
        yield database


def test_every_pinned_package_is_checked(database: Database) -> None:
    assert database.audit().returncode == 0
    assert len(database.queries) > 50
    database.vulnerable = "fastapi"
    result = database.audit()
    assert result.returncode == 1
    assert "fastapi" in result.stderr
    assert "PYSEC-1" in result.stderr


@pytest.mark.parametrize("body", [b"", b"[]", b'{"results": []}'])
def test_an_invalid_response_is_an_error(database: Database, body: bytes) -> None:
    database.invalid_body = body
    result = database.audit()
    assert result.returncode == 2
    assert "NOT CHECKED" in result.stderr
