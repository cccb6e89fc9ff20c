"""One trace from an HTTP request to the driver of a real agent and back, over real brokers."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.fakes.tracing import CALLER, TRACE, TRACEPARENT
from tests.harness.agent.pairing import paired_arm
from tests.harness.cloud.cloud import API
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.hosts.host import environment_of, start_program
from tests.harness.network.brokers import BROKERS, BrokerKind, wait_until
from tests.harness.network.otlp_receiver import OtlpReceiver, start_receiver
from tests.harness.paths import ROOT

MOVE = {"kind": "move_joints", "position_rad": {"shoulder_pan": 0.1}, "speed": 1.0}
SERVER, AGENT = "telescope-server", "telescope-agent"


class Installation:
    """Server, worker, broker and agent as processes, which export to ``receiver``."""

    def __init__(self, receiver: OtlpReceiver, processes: CloudProcesses, device: str) -> None:
        self.receiver = receiver
        self.device = device
        self._anna = processes.anna
        self._url = processes.url

    def post(self, path: str, body: object = None, **headers: str) -> httpx.Response:
        """A request of Anna to the process of the server."""
        headers["Authorization"] = f"Bearer {self._anna.token}"
        return httpx.post(f"{self._url}{API}/devices/{self.device}{path}", json=body, headers=headers, timeout=60)

    def lineage(self, name: str) -> list[tuple[str, str]]:
        """Service and name of a span and its ancestors, up to the client."""
        span = self.receiver.wait_for(name)
        found = [(span.service, span.name)]
        while span.parent != CALLER:
            span = self.receiver.wait_for_id(span.parent)
            found.append((span.service, span.name))
        return found


@contextlib.contextmanager
def installation(kind: BrokerKind, folder: Path, receiver: OtlpReceiver) -> Iterator[Installation]:
    environment = receiver.environment()
    with start_cloud_processes(kind, folder / "cloud", environment) as processes:
        processes.cloud.stop_ingest()  # the worker's process ingests
        device = paired_arm(processes, folder / "agent")
        worker = environment_of({**processes.environment, "OTEL_SERVICE_NAME": "telescope-worker"})
        command = [sys.executable, "-m", "device_agent", "run", "--home", str(folder / "agent")]
        with (
            start_program(["-m", "function_app", "work"], worker),
            (folder / "log").open("wb") as log,
            subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, env=os.environ | environment) as agent,
        ):
            try:
                wait_until(lambda: processes.anna.get(f"/devices/{device}").json()["online"], "the agent")
                yield Installation(receiver, processes, device)
            finally:
                agent.kill()


@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", BROKERS)
def test_an_action_and_a_stop_are_one_trace_each(kind: BrokerKind, tmp_path: Path) -> None:
    with start_receiver() as receiver, installation(kind, tmp_path, receiver) as telescope:
        body = {"request": MOVE, "wait_ms": 30_000, "wait_for": "done"}
        wait_until(lambda: telescope.post("/actions", body).json().get("status") == "done", "an action")
        assert not receiver.spans, "requests without a trace are not traced"
        assert telescope.post("/actions", body, traceparent=TRACEPARENT).json()["status"] == "done"

        route = "POST /api/v1/devices/{device}/actions"
        request, agent = (SERVER, route), (AGENT, "command move_joints")
        for step in ("check access", "write action, slot and lease", "publish command", "await acks", "store acks"):
            assert telescope.lineage(step) == [(SERVER, step), request]
        for step in ("accept", "execute", "publish ack"):
            assert telescope.lineage(step) == [(AGENT, step), agent, request]
        stored = telescope.lineage("store ack")
        assert stored == [("telescope-worker", "store ack"), (AGENT, "publish ack"), agent, request]
        assert sum(span.trace == TRACE for span in receiver.spans) == 11
        root = receiver.wait_for(route)
        assert root.attributes["http.response.status_code"] == 200
        motion = receiver.wait_for("execute")
        assert root.start_ns < motion.start_ns < motion.end_ns < root.end_ns

        receiver.spans.clear()
        assert telescope.post("/stop", {}, traceparent=TRACEPARENT).json()["outcome"] == "confirmed"
        request = (SERVER, "POST /api/v1/devices/{device}/stop")
        agent = (AGENT, "command stop_device")
        assert telescope.lineage("apply") == [(AGENT, "apply"), agent, request]
        assert telescope.lineage("store ack")[-2:] == [agent, request]


@pytest.mark.timeout(300)
def test_actions_run_without_delay_while_the_receiver_hangs(tmp_path: Path) -> None:
    with start_receiver() as receiver:
        receiver.answers.clear()
        with installation("amqtt", tmp_path, receiver) as telescope:
            body = {"request": MOVE, "wait_ms": 30_000, "wait_for": "done"}
            wait_until(
                lambda: telescope.post("/actions", body, traceparent=TRACEPARENT).json().get("status") == "done",
                "an action",
            )
            wait_until(lambda: receiver.requests >= 3, "exports of server, worker and agent")
            assert telescope.post("/actions", body, traceparent=TRACEPARENT).json()["status"] == "done"
            assert telescope.post("/stop", {}, traceparent=TRACEPARENT).json()["outcome"] == "confirmed"
            assert not receiver.spans
