"""Heartbeats: rows by which workers and timers show that they run.

A worker writes its row once per second. A cloud host has no worker; its timer writes the row ``timer`` at each run.
"""

import asyncio
import contextlib
import logging
import os
import re
import secrets
import socket
from dataclasses import dataclass, field

from device_agent.protocol import Ack, AckStatus, Presence, codec, topics
from device_agent.protocol.security import log_output
from device_agent.protocol.topics import Topic
from function_app.domain.health.server_health import Finding, Status
from function_app.ports.clock import Clock
from function_app.ports.tables import StoreError, Tables
from function_app.services.storage import records

BEAT_S = 1.0
LATE_MS = 3_000
FAILED_MS = 5_000
FORGET_MS = 600_000
"""A row is deleted after this time without a heartbeat; until then its worker is shown as failed."""
JOBS = "jobs"
"""Name of the timer that runs the periodic jobs."""
TIMER = "timer"
"""Name of the heartbeat of a cloud host's timer."""
SPACE = "telescope-server"
"""Space of the health messages. Ids of real spaces have another form, and agents cannot publish there."""
HEALTH_TOPICS = f"{topics.ROOT}/{SPACE}/"
_AGENT = "health"
_WORKERS = "workers"
_MAX_SERVERS = 16
_PERIODS = 2.5
"""A timer may miss one of its periods."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Heartbeat:
    """A worker, or the timer of a cloud host.

    Attributes:
        name: Name of the worker.
        host: Name of its machine.
        process: Its process id.
        version: Version of the server.
        started_ms: Its start [ms since 1970].
        seen_ms: The newest heartbeat [ms since 1970].
        period_ms: Longest regular time between two heartbeats [ms].
        timers: Name of a timer → end of its last successful run [ms since 1970].
        ingested: Name of a server → its newest health message that this worker stored [ms since 1970].
        agents_online: Connected agents.
        devices_online: Devices of connected agents.
        errors: Recent warnings and errors: time [ms since 1970], level, message.
    """

    name: str
    host: str
    process: int
    version: str
    started_ms: int
    seen_ms: int
    period_ms: int
    timers: dict[str, int] = field(default_factory=dict)
    ingested: dict[str, int] = field(default_factory=dict)
    agents_online: int = 0
    devices_online: int = 0
    errors: tuple[tuple[int, str, str], ...] = ()

    def age(self, now_ms: int) -> Finding:
        """Whether the heartbeat is in time."""
        return age_of(self.name, self.seen_ms, now_ms, self.period_ms)


def age_of(name: str, last_ms: int, now_ms: int, period_ms: int) -> Finding:
    """Whether something that runs once per ``period_ms`` ran in time. ``last_ms``: its last run [ms since 1970]."""
    age_ms = now_ms - last_ms
    late_ms, failed_ms = max(LATE_MS, _PERIODS * period_ms), max(FAILED_MS, _PERIODS * period_ms)
    text = f"{name}: last run {age_ms / 1000:.1f} s ago"
    if age_ms > failed_ms:
        return Finding(Status.FAILED, f"{text}. Restart the worker, and read its log.")
    if age_ms < -failed_ms:
        return Finding(Status.FAILED, f"{name}: its clock is {-age_ms / 1000:.1f} s ahead. Synchronise the clocks.")
    return Finding(Status.DEGRADED if age_ms > late_ms else Status.OK, text)


class Heartbeats:
    """Writes the heartbeat of this process, and reads those of all."""

    def __init__(self, *, tables: Tables, clock: Clock, version: str) -> None:
        self._tables = tables
        self._clock = clock
        self._host = socket.gethostname()
        self.name = f"{re.sub('[^A-Za-z0-9_-]', '-', self._host)[:40]}-{os.getpid()}"
        self._version = version
        self._started_ms = clock.now_ms()
        self._timers: dict[str, int] = {}
        self._ingested: dict[str, int] = {}
        self._online: dict[str, set[str]] = {}

    @property
    def host(self) -> str:
        """Name of this machine."""
        return self._host

    def ran(self, timer: str) -> None:
        """Record a successful run of a timer."""
        self._timers[timer] = self._clock.now_ms()

    def expect(self, *timers: str) -> None:
        """Record timers that begin now, so that one that never succeeds is reported."""
        for timer in timers:
            self.ran(timer)

    def probe(self) -> tuple[str, Ack]:
        """A new health message of this server and its device topic."""
        ack = Ack(id=secrets.token_hex(8), status=AckStatus.DONE, sequence=0, at_ms=self._clock.now_ms(), tick_ms=0)
        return f"{HEALTH_TOPICS}{_AGENT}/{self.name}", ack

    def observe(self, topic: Topic, payload: bytes) -> bool:
        """Count a received message; returns whether it is a health message, which needs no further storage.

        Raises:
            ProtocolError: The payload does not match its topic.
        """
        if topic.space == SPACE:
            self._ingested.pop(topic.device, None)
            self._ingested[topic.device] = codec.decode(payload, Ack).at_ms
            if len(self._ingested) > _MAX_SERVERS:
                del self._ingested[next(iter(self._ingested))]
            return True
        if topic.kind == topics.CONN:
            if codec.decode(payload, Presence).online:
                self._online.setdefault(topic.agent, set())
            else:
                self._online.pop(topic.agent, None)
        elif topic.kind == topics.STATE and topic.agent in self._online:
            self._online[topic.agent].add(topic.device)
        return False

    async def run(self) -> None:
        """Write the heartbeat once per second until cancelled; then delete it.

        Rows of ended processes of this machine are deleted first.
        """
        starting, reported = True, ""
        try:
            while True:
                try:
                    if starting:
                        await self._forget_ended()
                    starting = False
                    await self.beat(self.name, period_ms=round(BEAT_S * 1000))
                    reported = ""
                except Exception as error:  # noqa: BLE001 (the next heartbeat may succeed)
                    if str(error) != reported:
                        _log.warning("heartbeat: %s", error)
                    reported = str(error) or repr(error)
                await asyncio.sleep(BEAT_S)
        finally:
            with contextlib.suppress(StoreError):
                await records.remove(self._tables, records.WORKERS, _WORKERS, self.name)

    async def beat(self, name: str, *, period_ms: int) -> None:
        """Write one heartbeat.

        Raises:
            StoreError, Problem: It cannot be stored.
        """
        beat = Heartbeat(
            name=name,
            host=self._host,
            process=os.getpid(),
            version=self._version,
            started_ms=self._started_ms,
            seen_ms=self._clock.now_ms(),
            period_ms=period_ms,
            timers=self._timers,
            ingested=self._ingested,
            agents_online=len(self._online),
            devices_online=sum(map(len, self._online.values())),
            errors=tuple(log_output.recent.lines()),
        )
        await records.upsert(self._tables, records.WORKERS, _WORKERS, name, lambda _: beat, Heartbeat)

    async def timer_ran(self, *, period_ms: int) -> None:
        """Write the heartbeat of a cloud host's timer after its run.

        Raises:
            StoreError, Problem: It cannot be stored.
        """
        self.ran(JOBS)
        await self.beat(TIMER, period_ms=period_ms)

    async def all(self) -> list[Heartbeat]:
        """Heartbeats of all workers. Deletes those that ended long ago."""
        found = []
        async for row in records.all_rows(self._tables, records.WORKERS, _WORKERS):
            beat = records.read(row, Heartbeat)
            if self._clock.now_ms() - beat.seen_ms > FORGET_MS:
                await records.discard(self._tables, records.WORKERS, row)
            else:
                found.append(beat)
        return found

    async def _forget_ended(self) -> None:
        async for row in records.all_rows(self._tables, records.WORKERS, _WORKERS):
            beat = records.read(row, Heartbeat)
            if beat.host == self._host and not _runs(beat.process):
                await records.discard(self._tables, records.WORKERS, row)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
