"""The functions on one machine: ``python -m function_app serve``, and the tasks of ``work`` on request."""

import base64
import contextlib
import json
import socket
from collections.abc import Iterator, Mapping

from tests.harness.hosts.host import LOOPBACK, PATIENCE_S, Host, HostFailed, Program, environment_of, start_program
from tests.harness.network.brokers import wait_until
from tests.harness.network.ports import free_port


@contextlib.contextmanager
def start_uvicorn(environment: Mapping[str, str]) -> Iterator[Host]:
    """Start the server on a free port, and a worker that executes tasks on request."""
    port = free_port()
    settings = environment_of({"TELESCOPE_HOST": LOOPBACK, **environment, "TELESCOPE_PORT": str(port)})
    with (
        start_program(["-m", "function_app", "serve"], settings) as server,
        start_program(["-m", "tests.harness.hosts.stepwise_worker"], settings) as worker,
    ):
        wait_until(lambda: _listens(port) or server.process.poll() is not None, "the server", PATIENCE_S)
        assert server.process.poll() is None, server.stderr()
        yield _Uvicorn(f"http://{LOOPBACK}:{port}", worker)


class _Uvicorn:
    def __init__(self, url: str, worker: Program) -> None:
        self.url = url
        self._worker = worker

    def tick(self) -> None:
        self._do({"do": "sweep"})

    def deliver(self, topic: str, payload: bytes) -> None:
        self._do({"do": "ingest", "topic": topic, "payload": base64.b64encode(payload).decode()})

    def _do(self, step: dict[str, str]) -> None:
        self._worker.write_line(json.dumps(step))
        error = json.loads(self._worker.read_line())
        if error:
            raise HostFailed(error)


def _listens(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex((LOOPBACK, port)) == 0
