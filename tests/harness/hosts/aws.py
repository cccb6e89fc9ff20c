"""AWS Lambda: processes with Amazon's runtime client, a fake runtime API, and a fake API Gateway.

Each instance serves one request at a time and is frozen between requests by ``SIGSTOP``, as Lambda does. Concurrent
requests start further instances.
"""

import base64
import contextlib
import importlib.metadata
import json
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import unquote_to_bytes

from tests.harness.hosts.host import PATIENCE_S, HostFailed, Program, environment_of, start_program
from tests.harness.network.http_server import QuietHandler, serve
from tests.harness.paths import ROOT

MAX_INSTANCES = 8
MAX_EVENT_BYTES = 6 * 1024 * 1024
"""Lambda's limit for the request and the response of an invocation."""
_RUNTIME = "/2018-06-01/runtime"
_TEXT = re.compile(r"text/|application/(json|javascript|xml|[\w.+-]+\+json)")
_HANDLER = "function_app.entrypoints.hosts.aws.handler"
_ARN = "arn:aws:lambda:eu-west-1:123456789012:function:telescope"


@contextlib.contextmanager
def start_lambda(
    environment: Mapping[str, str], *, freeze: bool = True, package: Path | None = None, python: str = sys.executable
) -> Iterator["Lambda"]:
    """Start the functions behind a gateway on a free port; ``package``: use only the code and libraries in it."""
    with contextlib.ExitStack() as stack:
        instances = stack.enter_context(contextlib.ExitStack())
        host = Lambda(environment, instances, freeze=freeze, package=package, python=python)
        host.url = stack.enter_context(serve(_gateway(host)))
        stack.callback(host.thaw)
        yield host


def _runtime_client(package: Path, python: str) -> Path:
    """Amazon's runtime client for an interpreter: Lambda provides it, so it is not in the package."""
    folder = Path(tempfile.mkdtemp(dir=package.parent))
    pin = f"awslambdaric=={importlib.metadata.version('awslambdaric')}"
    command = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", python, "--target", str(folder)]
    subprocess.run([*command, pin], check=True)
    return folder


class Lambda:
    """The service: starts instances and sends events to them."""

    def __init__(
        self,
        environment: Mapping[str, str],
        stack: contextlib.ExitStack,
        *,
        freeze: bool,
        package: Path | None,
        python: str,
    ) -> None:
        self.url = ""
        self.instances: list[_Instance] = []
        self._environment = environment
        self._stack = stack
        self._freeze = freeze
        self._python = python
        self._folder, self._arguments = ROOT, ["-m", "awslambdaric", _HANDLER]
        self._libraries: dict[str, str] = {}
        if package is not None:
            self._folder, self._arguments = package, ["-S", *self._arguments]
            self._libraries = {"PYTHONPATH": f"{package}{os.pathsep}{_runtime_client(package, python)}"}
        self._lock = threading.Lock()
        self._idle: list[_Instance] = []

    def tick(self) -> None:
        self.invoke(
            {
                "version": "0",
                "id": str(uuid.uuid4()),
                "source": "aws.events",
                "detail-type": "Scheduled Event",
                "resources": ["arn:aws:events:eu-west-1:123456789012:rule/sweep"],
                "detail": {},
            }
        )

    def deliver(self, topic: str, payload: bytes) -> None:
        at_ms = time.time_ns() // 1_000_000
        self.invoke({"topic": topic, "payload": base64.b64encode(payload).decode(), "at_ms": at_ms})

    def invoke(self, event: dict[str, Any]) -> Any:
        """Invoke the function; returns its response.

        Raises:
            HostFailed: The function failed.
        """
        with self._lock:
            instance = self._idle.pop() if self._idle else self._start()
        try:
            outcome = instance.run(event)
        finally:
            with self._lock:
                self._idle.append(instance)
        if "error" in outcome:
            raise HostFailed(json.dumps(outcome["error"]))
        return outcome["response"]

    def thaw(self) -> None:
        """Resume all instances and stop freezing them, so that they can end."""
        for instance in self.instances:
            instance.thaw()

    def _start(self) -> "_Instance":
        assert len(self.instances) < MAX_INSTANCES, "more concurrent requests than permitted instances"
        instance = _Instance(freeze=self._freeze)
        address = self._stack.enter_context(serve(_runtime_api(instance))).removeprefix("http://")
        settings = environment_of(
            {
                "AWS_REGION": "eu-west-1",
                **self._environment,
                "AWS_LAMBDA_RUNTIME_API": address,
                "AWS_LAMBDA_FUNCTION_NAME": "telescope",
                "AWS_LAMBDA_FUNCTION_MEMORY_SIZE": "512",
                "AWS_EXECUTION_ENV": "AWS_Lambda_python3.11",
                "_HANDLER": _HANDLER,
                **self._libraries,
            }
        )
        instance.program = self._stack.enter_context(
            start_program(self._arguments, settings, folder=self._folder, python=self._python)
        )
        self.instances.append(instance)
        return instance


class _Instance:
    """One process that polls for events and responds."""

    def __init__(self, *, freeze: bool) -> None:
        self.program: Program | None = None
        self.events: queue.Queue[dict[str, Any]] = queue.Queue()
        self.outcomes: queue.Queue[dict[str, Any]] = queue.Queue()
        self._freeze = freeze
        self._freezing = threading.Lock()

    def run(self, event: dict[str, Any]) -> dict[str, Any]:
        self.events.put(event)
        deadline = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(queue.Empty):
                return self.outcomes.get(timeout=0.2)
            assert self.program is not None
            assert self.program.process.poll() is None, f"the instance ended: {self.program.stderr()}"
            assert time.monotonic() < deadline, f"the instance does not respond: {self.program.stderr()}"

    def next(self) -> dict[str, Any]:
        """The next event. Freezes the process until one exists."""
        with contextlib.suppress(queue.Empty):
            return self.events.get_nowait()
        self._signal(signal.SIGSTOP)
        event = self.events.get()
        self._signal(signal.SIGCONT)
        return event

    def thaw(self) -> None:
        """Resume the process and stop freezing it."""
        self._signal(signal.SIGCONT, last=True)

    def _signal(self, number: signal.Signals, *, last: bool = False) -> None:
        with self._freezing:
            freeze, self._freeze = self._freeze, self._freeze and not last
            if freeze and self.program is not None and self.program.process.poll() is None:
                os.kill(self.program.process.pid, number)


class _Handler(QuietHandler):
    protocol_version = "HTTP/1.1"

    def read(self) -> bytes:
        if self.headers.get("transfer-encoding", "").lower() != "chunked":
            return self.rfile.read(int(self.headers.get("content-length", 0)))
        parts = []
        while length := int(self.rfile.readline(), 16):
            parts.append(self.rfile.read(length))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(parts)


def _runtime_api(instance: _Instance) -> type[_Handler]:
    class RuntimeApi(_Handler):
        def handle_any(self) -> None:
            if self.command == "POST":
                outcome = "response" if self.path.endswith("/response") else "error"
                instance.outcomes.put({outcome: json.loads(self.read())})
                self.respond(202, [], b"{}")
                return
            assert self.path == f"{_RUNTIME}/invocation/next", self.path
            event = instance.next()
            deadline_ms = time.time_ns() // 1_000_000 + 30_000
            headers = {
                "Lambda-Runtime-Aws-Request-Id": str(uuid.uuid4()),
                "Lambda-Runtime-Deadline-Ms": str(deadline_ms),
                "Lambda-Runtime-Invoked-Function-Arn": _ARN,
                "Content-Type": "application/json",
            }
            self.respond(200, list(headers.items()), json.dumps(event).encode())

    return RuntimeApi


def _gateway(service: Lambda) -> type[_Handler]:
    class Gateway(_Handler):
        """An HTTP API with a ``$default`` route, payload format 2.0."""

        hop_by_hop: ClassVar = {"connection", "transfer-encoding", "content-length", "keep-alive"}

        def handle_any(self) -> None:
            event = self._event(self.read())
            if len(json.dumps(event)) > MAX_EVENT_BYTES:
                self.respond_json({"message": "Request Too Long"}, 413)
                return
            try:
                answer = service.invoke(event)
            except HostFailed:
                self.respond_json({"message": "Internal Server Error"}, 500)
                return
            assert len(json.dumps(answer)) <= MAX_EVENT_BYTES
            content = answer.get("body", "")
            body = base64.b64decode(content) if answer.get("isBase64Encoded") else content.encode()
            headers = [(name, value) for name, value in answer["headers"].items() if name not in self.hop_by_hop]
            headers += [("set-cookie", cookie) for cookie in answer.get("cookies", ())]
            self.respond(answer["statusCode"], headers, body)

        def _event(self, body: bytes) -> dict[str, Any]:
            path, _, query = self.path.partition("?")
            headers: dict[str, str] = {}
            for name, value in self.headers.items():
                key = name.lower()
                if key not in {*self.hop_by_hop, "cookie"} or key == "content-length":
                    headers[key] = f"{headers[key]},{value}" if key in headers else value
            cookies = [part.strip() for line in self.headers.get_all("cookie", ()) for part in line.split(";")]
            decoded = unquote_to_bytes(path).decode(errors="replace")
            return {
                "version": "2.0",
                "routeKey": "$default",
                "rawPath": decoded,
                "rawQueryString": query,
                **({"cookies": cookies} if cookies else {}),
                "headers": {"x-forwarded-proto": "https", "x-forwarded-port": "443", **headers},
                "requestContext": {
                    "accountId": "123456789012",
                    "apiId": "api",
                    "http": {
                        "method": self.command,
                        "path": decoded,
                        "protocol": "HTTP/1.1",
                        "sourceIp": self.client_address[0],
                        "userAgent": headers.get("user-agent", ""),
                    },
                    "requestId": uuid.uuid4().hex,
                    "routeKey": "$default",
                    "stage": "$default",
                    "timeEpoch": time.time_ns() // 1_000_000,
                },
                **_body(body, headers.get("content-type", "")),
            }

    return Gateway


def _body(body: bytes, kind: str) -> dict[str, Any]:
    if not body:
        return {"isBase64Encoded": False}
    if _TEXT.match(kind):
        with contextlib.suppress(UnicodeDecodeError):
            return {"body": body.decode(), "isBase64Encoded": False}
    return {"body": base64.b64encode(body).decode(), "isBase64Encoded": True}
