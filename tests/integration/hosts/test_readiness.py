"""A part of a running server that stops working is shown within 5 s, and as repaired within 10 s."""

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from function_app.ports.command_bus import BusUnavailable
from tests.harness.cloud.cloud import API
from tests.harness.cloud.cloud_processes import CloudProcesses, Server, start_cloud_processes
from tests.harness.hosts.host import Program, environment_of, start_program
from tests.harness.network.brokers import BrokerKind, wait_until
from tests.harness.stores.small_disk import small_disk

TOKEN = "a-token-of-the-monitoring"  # pragma: allowlist secret
SHOWN_S = 5.0
REPAIRED_S = 10.0
DISK_MB = 48
MIN_FREE_MB = 20
FAILING = 2_000
MAX_LOGGED = 20_000
"""Bytes that server and worker may log for so many messages that cannot be stored."""
MAX_IDLE = 1_000
"""Bytes that they may log in two seconds during a fault, when all messages have been processed."""


class Site:
    """A server, a broker and a worker, and their health as a monitoring system reads it."""

    def __init__(self, processes: CloudProcesses, stack: contextlib.ExitStack) -> None:
        self.processes = processes
        self._stack = stack
        self._environment = environment_of(processes.environment)
        self.http = stack.enter_context(
            httpx.Client(base_url=processes.url + API, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=15)
        )
        self.worker = self.start_worker()

    def start_worker(self) -> Program:
        self.worker = self._stack.enter_context(start_program(["-m", "function_app", "work"], self._environment))
        return self.worker

    def parts(self) -> dict[str, dict[str, Any]]:
        return {part["name"]: part for part in self.http.get("/health/ready").json()["parts"]}

    def not_ok(self) -> set[str]:
        return {name for name, part in self.parts().items() if part["status"] != "ok"} - {"models"}

    def logged_bytes(self) -> int:
        """How much the programs log for requests and messages that fail."""
        server = self.processes.endpoints["server"]
        assert isinstance(server, Server)
        assert server._program is not None
        programs = (server._program, self.worker)

        def logged() -> int:
            return sum(len(program.stderr()) for program in programs)

        before = logged()
        cloud = self.processes.cloud
        with contextlib.suppress(BusUnavailable):
            for _ in range(FAILING):
                cloud.run(cloud.functions.bus.publish("ts/v1/s/a/arm/ack", b"no ack"))
        for _ in range(FAILING // 10):
            self.http.post("/auth/sign-in", json={"account": "anna", "password": "wrong"})
        size = -1
        while logged() - size > MAX_IDLE:  # a full disk may also stop the heartbeats, so the ingest is not known
            size = logged()
            time.sleep(2)
        return size - before

    def await_ok(self) -> float:
        try:
            return _duration_s(lambda: not self.not_ok(), "health that is ok")
        except AssertionError as error:
            left = [part for part in self.parts().values() if part["status"] != "ok"]
            raise AssertionError(f"{error}: {left}; worker: {self.worker.stderr()[-2000:]}") from None

    def await_shown(self, part: str) -> float:
        return _duration_s(lambda: part in self.not_ok(), f"failed {part}")


def _duration_s(condition: Callable[[], object], what: str) -> float:
    started_s = time.monotonic()
    wait_until(condition, what)
    return time.monotonic() - started_s


@contextlib.contextmanager
def start_site(kind: BrokerKind, folder: Path) -> Iterator[Site]:
    more = {"TELESCOPE_METRICS_TOKEN": TOKEN, "TELESCOPE_MIN_FREE_MB": str(MIN_FREE_MB)}
    with contextlib.ExitStack() as stack:
        site = Site(stack.enter_context(start_cloud_processes(kind, folder, more)), stack)
        site.await_ok()
        yield site


@pytest.fixture(scope="module", params=["amqtt", "mosquitto"])
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with start_site(request.param, tmp_path_factory.mktemp(request.param)) as started:
        yield started


def in_time(shown_s: float, repaired_s: float) -> None:
    assert (shown_s <= SHOWN_S, repaired_s <= REPAIRED_S) == (True, True), (shown_s, repaired_s)


def test_a_suspended_worker_is_shown(site: Site) -> None:
    os.kill(site.worker.process.pid, signal.SIGSTOP)
    try:
        shown_s = max(site.await_shown("workers"), site.await_shown("timers"))
        wait_until(lambda: site.http.get("/health/ready").status_code == 503, "not ready")
        wait_until(lambda: site.parts()["ingest"]["status"] == "failed", "a failed ingest")
        assert httpx.get(site.processes.url + API + "/health").json()["status"] == "degraded"
    finally:
        os.kill(site.worker.process.pid, signal.SIGCONT)
    in_time(shown_s, site.await_ok())


def test_a_killed_worker_is_shown_until_another_runs(site: Site) -> None:
    site.worker.process.kill()
    shown_s = site.await_shown("workers")
    site.worker.process.wait()
    site.start_worker()
    in_time(shown_s, site.await_ok())


def test_a_stopped_worker_is_shown_at_once(site: Site) -> None:
    site.worker.process.terminate()
    site.worker.process.wait()
    shown_s = site.await_shown("workers")
    assert "No worker runs" in site.parts()["workers"]["message"]
    site.start_worker()
    in_time(shown_s, site.await_ok())


def test_a_missing_and_a_replaced_tables_file_are_shown(site: Site) -> None:
    file = site.processes.home / "tables.sqlite"
    aside = file.with_name("aside.sqlite")
    for replacement in (b"", None):
        file.rename(aside)
        if replacement is not None:
            file.write_bytes(replacement)
        try:
            shown_s = site.await_shown("tables")
            assert site.logged_bytes() <= MAX_LOGGED
            assert "restore a backup" in site.parts()["tables"]["message"]
            assert httpx.get(site.processes.url + API + "/health").status_code == 503
        finally:
            aside.rename(file)
        in_time(shown_s, site.await_ok())


def test_a_frozen_and_a_killed_broker_are_shown(site: Site) -> None:
    broker = site.processes.broker
    process = broker.running.process.pid
    everything = [
        process,
        *(int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()),
    ]
    for each in everything:
        os.kill(each, signal.SIGSTOP)
    shown_s = site.await_shown("broker")
    for each in everything:
        os.kill(each, signal.SIGCONT)
    in_time(shown_s, site.await_ok())
    broker.running.stop()
    shown_s = site.await_shown("broker")
    assert site.logged_bytes() <= MAX_LOGGED
    broker.revive()
    in_time(shown_s, site.await_ok())


def test_a_full_disk_is_shown(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", DISK_MB) as folder, start_site("amqtt", folder) as site:
        filler = folder / "filler"
        with contextlib.suppress(OSError), filler.open("wb") as file:
            while True:
                file.write(bytes(1_000_000))
        shown_s = site.await_shown("disk")
        wait_until(lambda: site.parts()["disk"]["status"] == "failed", "a full disk")
        assert "Free disk space" in site.parts()["disk"]["message"]
        assert site.logged_bytes() <= MAX_LOGGED
        filler.unlink()
        in_time(shown_s, site.await_ok())


def test_callers_without_rights_see_the_status_only(site: Site) -> None:
    answer = httpx.get(site.processes.url + API + "/health/ready")
    assert (answer.status_code, answer.json()) == (200, {"status": "ok", "parts": None})
    assert httpx.get(site.processes.url + API + "/health/live").json() == {"status": "ok"}
