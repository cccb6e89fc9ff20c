"""The state of each part of the server, measured by use: write, publish, receive."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from device_agent.protocol import codec, topics
from function_app.domain.common.problems import Problem
from function_app.domain.health.server_health import Finding, Part, Status, disk_space, worst
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable, CommandBus
from function_app.ports.tables import StoreError, Tables
from function_app.services.maintenance.heartbeats import FAILED_MS, LATE_MS, Heartbeat, Heartbeats, age_of
from function_app.services.robot_types.rows import read_refusal
from function_app.services.storage import records

CHECK_EVERY_MS = 1_000
TIMEOUT_S = 2.0
"""A part that does not answer in this time has failed."""
_PROBES = "probes"
_CONTENT = b"health check"
_MAX_WAITING = 100
_MAX_SHOWN = 5
_NO_WORKER = "No worker runs: messages of devices are not stored. Start `telescope-server work`."
_UNREAD = Finding(Status.FAILED, "Not known, because the heartbeats of the workers cannot be read.")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Health:
    """The parts of the server at one time."""

    parts: tuple[Part, ...]
    workers: tuple[Heartbeat, ...] = ()
    ingest_lag_ms: int = 0

    @property
    def status(self) -> Status:
        """The worst status of a part."""
        return worst(self.parts)

    def failed(self, name: str) -> bool:
        """Whether a part has failed."""
        return any(part.name == name and part.status is Status.FAILED for part in self.parts)

    def text(self, name: str) -> str:
        """``ok``, or the message of a part; ``ok`` if it is not checked."""
        part = next((part for part in self.parts if part.name == name), None)
        return "ok" if part is None or part.status is Status.OK else part.message


class ReadinessCheck:
    """Checks all parts at most once per second; callers in between receive the last result.

    Args:
        tables: Tables.
        blobs: Blobs.
        bus: The command bus. Only a bus with a subscription can measure its round trip and the ingest.
        heartbeats: Of the workers.
        free_bytes: Free disk space [bytes]; ``None`` for a cloud store.
        min_free_bytes: Free disk space below which data are rejected [bytes].
        subscribes: Whether workers receive messages from a subscription; a cloud calls the ingest instead.
        clock: Clock.
    """

    def __init__(
        self,
        *,
        tables: Tables,
        blobs: Blobs,
        bus: CommandBus,
        heartbeats: Heartbeats,
        free_bytes: Callable[[], int | None],
        min_free_bytes: int,
        subscribes: bool,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._blobs = blobs
        self._bus = bus
        self._heartbeats = heartbeats
        self._free_bytes = free_bytes
        self._min_free_bytes = min_free_bytes
        self._subscribes = subscribes
        self._clock = clock
        self._turn = asyncio.Lock()
        self._checked_ms: int | None = None
        self._health = Health(())
        self._sent: deque[int] = deque()
        """Times of health messages that no worker has stored [ms]."""

    async def require_tables(self) -> None:
        """Read a row.

        Raises:
            StoreError: The tables are not available.
        """
        await self._tables.get(records.ACCOUNTS, "health", "health")

    async def watch(self) -> None:
        """Check the parts continuously until cancelled, so that a failure is known before it is asked for."""
        while True:
            await self.check()
            await asyncio.sleep(CHECK_EVERY_MS / 1000)

    async def check(self) -> Health:
        """The parts, not older than a second."""
        async with self._turn:
            now_ms = self._clock.now_ms()
            if self._checked_ms is None or not 0 <= now_ms - self._checked_ms < CHECK_EVERY_MS:
                self._health = await self._measure()
                # Its end, so that callers that waited for a slow check do not start another.
                self._checked_ms = self._clock.now_ms()
            return self._health

    async def _measure(self) -> Health:
        workers: list[Heartbeat] | None = None

        async def read_workers() -> Finding:
            nonlocal workers
            workers = await self._heartbeats.all()
            return self._workers(workers)

        checks: list[tuple[str, Callable[[], Awaitable[Finding]]]] = [
            ("tables", self._check_tables),
            ("blobs", self._check_blobs),
            ("broker", self._check_broker),
            ("models", self._check_models),
            ("workers", read_workers),
        ]
        results = await asyncio.gather(*(_guarded(name, check) for name, check in checks))
        findings = {name: result for (name, _), result in zip(checks, results, strict=True)}
        findings["disk"] = await _guarded("disk", self._check_disk)
        findings["timers"] = _UNREAD if workers is None else self._timers(workers)
        if self._subscribes:
            findings["ingest"] = _UNREAD if workers is None else self._ingest(workers)
        earlier = {part.name: part for part in self._health.parts}
        now_ms = self._clock.now_ms()
        parts = []
        for name, finding in findings.items():
            last = earlier.get(name)
            since_ms = last.since_ms if last is not None and last.status is finding.status else now_ms
            parts.append(Part(name, finding.status, finding.message, since_ms))
            if last is not None and last.status is not finding.status:
                _log.warning("health of %s: %s: %s", name, finding.status, finding.message)
        return Health(tuple(parts), tuple(workers or ()), self._lag_ms())

    async def _check_tables(self) -> Finding:
        """A row can be written and read, and no data are known to be lost or damaged."""
        started_s, now_ms = time.perf_counter(), self._clock.now_ms()
        key = self._heartbeats.host
        await records.upsert(self._tables, records.WORKERS, _PROBES, key, lambda _: {"at_ms": now_ms}, dict)
        row = await self._tables.get(records.WORKERS, _PROBES, key)
        if row is None:
            return Finding(Status.FAILED, "A row that was written is missing. Restore a backup.")
        problems = await self._tables.check()
        if problems:
            return Finding(Status.DEGRADED, " ".join(problems))
        return _took("written and read", started_s)

    async def _check_blobs(self) -> Finding:
        started_s = time.perf_counter()
        name = f"health/{self._heartbeats.host}"
        await self._blobs.put(name, _CONTENT)
        if await self._blobs.get(name) != _CONTENT:
            return Finding(Status.FAILED, "A blob that was written has another content. Check the disk.")
        return _took("written and read", started_s)

    async def _check_disk(self) -> Finding:
        return disk_space(self._free_bytes(), self._min_free_bytes)

    async def _check_broker(self) -> Finding:
        topic, probe = self._heartbeats.probe()
        async with self._bus.acks(topic, probe.id) as acks:
            if acks is None:
                status = await self._bus.status()
                return Finding(Status.OK if status == "ok" else Status.FAILED, status)
            started_s = time.perf_counter()
            await self._bus.publish(f"{topic}/{topics.ACK}", codec.encode(probe))
            if len(self._sent) < _MAX_WAITING:
                self._sent.append(probe.at_ms)
            await anext(acks)
        return _took("published and received", started_s)

    async def _check_models(self) -> Finding:
        refusal = await read_refusal(self._tables)
        return Finding(Status.DEGRADED if refusal else Status.OK, refusal or "uploaded models are checked")

    def _workers(self, workers: list[Heartbeat]) -> Finding:
        if not workers:
            return Finding(Status.FAILED, _NO_WORKER)
        now_ms = self._clock.now_ms()
        return _summary([beat.age(now_ms) for beat in workers])

    def _timers(self, workers: list[Heartbeat]) -> Finding:
        """Each timer runs in one of the workers."""
        now_ms = self._clock.now_ms()
        newest: dict[str, tuple[int, int]] = {}
        for beat in workers:
            for name, ran_ms in beat.timers.items():
                newest[name] = max(newest.get(name, (0, 0)), (ran_ms, beat.period_ms))
        findings = [age_of(name, ran_ms, now_ms, period_ms) for name, (ran_ms, period_ms) in sorted(newest.items())]
        if not findings:
            return Finding(Status.FAILED, _NO_WORKER)
        return Finding(worst(findings), _messages(findings))

    def _lag_ms(self) -> int:
        return self._clock.now_ms() - self._sent[0] if self._sent else 0

    def _ingest(self, workers: list[Heartbeat]) -> Finding:
        """The age of the oldest health message of this server that no running worker has stored."""
        now_ms = self._clock.now_ms()
        running = [beat for beat in workers if beat.age(now_ms).status is not Status.FAILED]
        if not running:
            return Finding(Status.FAILED, _NO_WORKER)
        stored_ms = max(beat.ingested.get(self._heartbeats.name, 0) for beat in running)
        while self._sent and self._sent[0] <= stored_ms:
            self._sent.popleft()
        lag_ms = self._lag_ms()
        text = f"the oldest waiting message is {lag_ms / 1000:.1f} s old"
        if lag_ms > FAILED_MS:
            return Finding(Status.FAILED, f"{text}. Read the log of the worker, and check the broker.")
        return Finding(Status.DEGRADED if lag_ms > LATE_MS else Status.OK, text)


async def _guarded(name: str, check: Callable[[], Awaitable[Finding]]) -> Finding:
    """The result of a check. One that raises or does not answer has failed."""
    try:
        async with asyncio.timeout(TIMEOUT_S):
            return await check()
    except (StoreError, BusUnavailable, Problem) as error:
        return Finding(Status.FAILED, str(error))
    except TimeoutError:
        return Finding(Status.FAILED, f"no answer within {TIMEOUT_S:.0f} s")
    except Exception as error:  # noqa: BLE001 (an unforeseen error is a failed part)
        _log.exception("health check of %s", name)
        return Finding(Status.FAILED, f"{type(error).__name__}: {error}")


def _took(what: str, started_s: float) -> Finding:
    return Finding(Status.OK, f"{what} in {1000 * (time.perf_counter() - started_s):.0f} ms")


def _summary(findings: list[Finding]) -> Finding:
    """``failed`` if all failed, ``degraded`` if some did not run in time."""
    status = worst(findings)
    if status is Status.FAILED and any(each.status is not Status.FAILED for each in findings):
        status = Status.DEGRADED
    return Finding(status, _messages(findings))


def _messages(findings: list[Finding]) -> str:
    shown = [each.message for each in findings if each.status is not Status.OK] or [each.message for each in findings]
    return "; ".join(shown[:_MAX_SHOWN])
