"""Azure Functions: Microsoft's worker in a process, behind a fake Functions host."""

import base64
import contextlib
import http.client
import json
import secrets
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from tests.harness.hosts.host import PATIENCE_S, Host, HostFailed, environment_of, isolated_path, start_program

WORKER = Path(sys.prefix) / "azure-worker"
"""Folder into which ``make`` installs the worker, separately because its metadata requires a newer Python."""


@contextlib.contextmanager
def start_azure(
    environment: Mapping[str, str], *, package: Path | None = None, python: str = sys.executable
) -> Iterator[Host]:
    """Start the worker on a free port and load the functions; ``package``: use only the libraries in it."""
    assert any(WORKER.glob("azure_functions_runtime")), f"the Functions worker is not in {WORKER}; run `make test`"
    arguments, more = ["-m", "tests.harness.hosts.functions_host", str(WORKER)], {}
    if package is not None:
        arguments, more = ["-S", *arguments], isolated_path(package, "uvicorn", "h11", "click")
    with start_program(arguments, environment_of({**environment, **more}), python=python) as program:
        yield _Azure(program.read_line())


class _Azure:
    """Fires the functions without HTTP trigger through administrative addresses of the host."""

    def __init__(self, url: str) -> None:
        self.url = url

    def tick(self) -> None:
        self._post("/admin/functions/sweep", {"input": ""}, {})

    def deliver(self, topic: str, payload: bytes) -> None:
        event = {
            "specversion": "1.0",
            "id": secrets.token_hex(8),
            "source": "telescope-namespace",
            "type": "MQTT.EventPublished",
            "subject": topic,
            "time": "2026-01-01T00:00:00Z",
            "data_base64": base64.b64encode(payload).decode(),
        }
        self._post("/runtime/webhooks/eventgrid?functionName=ingest", [event], {"aeg-event-type": "Notification"})

    def _post(self, path: str, body: Any, headers: dict[str, str]) -> None:
        address = urlsplit(self.url)
        connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=PATIENCE_S)
        try:
            connection.request("POST", path, json.dumps(body), {"content-type": "application/json", **headers})
            answer = connection.getresponse()
            text = answer.read().decode()
            if answer.status != 202:
                raise HostFailed(f"{answer.status} {text}")
        finally:
            connection.close()
