"""Emulated AWS services, and an HTTP proxy that injects faults.

with start_moto() as endpoint, start_fault_proxy(endpoint) as proxy:
    tables = DynamoTables(table="t", region=REGION, endpoint=proxy.endpoint)
    proxy.inject("lose response")
"""

import contextlib
import http.client
import json
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal
from urllib.parse import urlsplit

import pytest
from moto.moto_server.werkzeug_app import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
from werkzeug.serving import make_server

from tests.harness.network.http_server import QuietHandler, running, serve

HOST = "127.0.0.1"
REGION = "eu-west-1"
CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "testing",
    "AWS_SECRET_ACCESS_KEY": "testing",
    "AWS_CONFIG_FILE": "/dev/null",
    "AWS_SHARED_CREDENTIALS_FILE": "/dev/null",
    "AWS_EC2_METADATA_DISABLED": "true",
}


@contextlib.contextmanager
def start_moto() -> Iterator[str]:
    """Run moto as an HTTP server on a free loopback port; yields its address."""
    logging.getLogger("werkzeug").setLevel(logging.WARNING)
    app = _OneAtATime(DomainDispatcherApplication(create_backend_app))
    server = make_server(HOST, 0, app, threaded=True, request_handler=MotoRequestHandler)
    with running(server):
        yield f"http://{HOST}:{server.server_port}"


def reset(endpoint: str) -> None:
    """Delete all data of moto."""
    address = urlsplit(endpoint)
    connection = http.client.HTTPConnection(address.hostname or HOST, address.port)
    connection.request("POST", "/moto-api/reset")
    assert connection.getresponse().status == 200
    connection.close()


class _OneAtATime:
    """Serializes requests, because a transaction of moto, unlike DynamoDB's, undoes concurrent writes."""

    def __init__(self, app: Any) -> None:
        self._app = app
        self._lock = threading.Lock()

    def __call__(self, environ: dict[str, Any], start_response: Any) -> list[bytes]:
        with self._lock:
            return list(self._app(environ, start_response))


def use_credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use credentials that moto accepts, and no configuration of this machine."""
    for name, value in CREDENTIALS.items():
        monkeypatch.setenv(name, value)
    for name in ("AWS_PROFILE", "AWS_SESSION_TOKEN", "AWS_ENDPOINT_URL"):
        monkeypatch.delenv(name, raising=False)


@dataclass(frozen=True)
class Request:
    """A received request."""

    method: str
    operation: str
    """The DynamoDB operation; empty for S3."""
    body: bytes
    path: str = ""

    @property
    def json(self) -> dict[str, Any]:
        body: dict[str, Any] = json.loads(self.body)
        return body


@dataclass(frozen=True)
class Refusal:
    """An error response instead of the emulator's response."""

    status: int
    code: str
    more: dict[str, Any]
    kind: str = ""
    """Content type; default: that of the service."""


Fault = Literal["lose request", "lose response", "cut response", "pass"] | Refusal | Callable[[], object]
"""A function is called before the request is forwarded."""


class FaultProxy:
    """Records requests and applies the injected faults in order; later requests pass.

    Attributes:
        guard: Called with method, path and headers; rejects what the emulator does not check.
    """

    def __init__(self, endpoint: str) -> None:
        self.requests: list[Request] = []
        self.endpoint = ""
        self.behind = urlsplit(endpoint)
        self.faults: deque[Fault] = deque()
        self.guard: Callable[[str, str, Mapping[str, str]], Refusal | None] | None = None

    def inject(self, *faults: Fault) -> None:
        self.requests.clear()
        self.faults.extend(faults)

    @property
    def operations(self) -> list[str]:
        return [request.operation or request.method for request in self.requests]


@contextlib.contextmanager
def start_fault_proxy(endpoint: str) -> Iterator[FaultProxy]:
    """Run a proxy in front of an emulator."""
    proxy = FaultProxy(endpoint)

    class Handler(_Handler):
        between = proxy

    with serve(Handler) as proxy.endpoint:
        yield proxy


class _Handler(QuietHandler):
    protocol_version = "HTTP/1.1"
    between: FaultProxy

    def handle_any(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        operation = self.headers.get("X-Amz-Target", "").rpartition(".")[2]
        self.between.requests.append(Request(self.command, operation, body, self.path))
        fault = self.between.faults.popleft() if self.between.faults else "pass"
        if fault == "pass" and self.between.guard is not None:
            fault = self.between.guard(self.command, self.path, dict(self.headers)) or "pass"
        if isinstance(fault, Refusal):
            self._refuse(fault)
            return
        if callable(fault):
            fault()
        answer = None if fault == "lose request" else self._forward(body)
        if answer is None or fault == "lose response":
            self.close_connection = True
            return
        if fault == "cut response":
            self.close_connection = True
            status, headers, content = answer
            self._answer(status, headers, content, sent=len(content) // 2)
            return
        self._answer(*answer)

    def _forward(self, body: bytes) -> tuple[int, list[tuple[str, str]], bytes]:
        behind = http.client.HTTPConnection(self.between.behind.hostname or HOST, self.between.behind.port)
        try:
            behind.putrequest(self.command, self.path, skip_host=True, skip_accept_encoding=True)
            for name, value in self.headers.items():
                if name.lower() != "expect":
                    behind.putheader(name, value)
            behind.endheaders(body)
            response = behind.getresponse()
            return response.status, response.getheaders(), response.read()
        finally:
            behind.close()

    def _refuse(self, fault: Refusal) -> None:
        if "X-Amz-Target" in self.headers:
            kind = "application/x-amz-json-1.0"
            text = json.dumps(
                {"__type": f"com.amazonaws.dynamodb.v20120810#{fault.code}", "message": "…", **fault.more}
            )
        elif fault.kind == "application/json":
            kind = fault.kind
            text = json.dumps({"__type": fault.code, "message": "no"})
        else:
            kind = "application/xml"
            text = f"<Error><Code>{fault.code}</Code><Message>no</Message></Error>"
        self._answer(fault.status, [("Content-Type", fault.kind or kind)], text.encode())

    def _answer(self, status: int, headers: list[tuple[str, str]], content: bytes, *, sent: int | None = None) -> None:
        self.send_response_only(status)
        for name, value in headers:
            if name.lower() not in ("content-length", "transfer-encoding", "connection"):
                self.send_header(name, value)
        length = next((value for name, value in headers if name.lower() == "content-length"), str(len(content)))
        self.send_header("Content-Length", length if self.command == "HEAD" else str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content[:sent])
