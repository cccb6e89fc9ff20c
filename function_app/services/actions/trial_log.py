"""Stores trials of tasks and published batches. A trial follows from its action, so recording is idempotent."""

import asyncio
import heapq
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import msgspec

from device_agent.protocol import TrialCause, TrialReport
from function_app.domain.actions.action import Action, Status, is_lost
from function_app.domain.actions.trials import Trial, TrialBatch
from function_app.domain.common.ids import new_suffix, split_command
from function_app.domain.devices.devices import Device
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS, Retention

KIND: Final = "run_trial"
"""Kind of the action that runs a trial."""
KEEP_MS: Final = 730 * DAY_MS
"""Time that trials are stored [ms]."""
NOT_REPORTED: Final = "The device did not report a verdict."
"""Detail of a trial whose outcome is unknown."""
_CONCURRENT_READS: Final = 16
_MAX_PAGE: Final = 1_000
"""Most rows that one query of a table returns."""


class TrialLog:
    """Stores trials."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock

    async def record(self, action: Action) -> None:
        """Record the present state of an action, if it is a trial. Raises ``busy``."""
        if action.request.get("kind") != KIND:
            return
        partition, key = f"{action.device}/{action.pairing}", _key(action.id)
        trial = trial_of(action)
        if trial is None:
            await records.remove(self._tables, records.TRIALS, partition, key)
            return
        due_ms = trial.started_ms + KEEP_MS
        stored = replace(trial, expires_ms=due_ms)
        row, existing = await records.find(self._tables, records.TRIALS, partition, key, Trial)
        if existing == stored:
            return
        if row is None:
            await self._retention.delete_row_at(records.TRIALS, partition, key, due_ms=due_ms)
        await records.upsert(
            self._tables, records.TRIALS, partition, key, lambda each: None if each == stored else stored, Trial
        )

    async def read(self, devices: Sequence[Device], *, after: str = "", limit: int) -> list[Trial]:
        """Trials of devices, newest first, that are older than the trial with the key ``after``."""
        rows: list[Row] = []
        for first in range(0, len(devices), _CONCURRENT_READS):
            pages = await asyncio.gather(
                *(self._page(device, after, limit) for device in devices[first : first + _CONCURRENT_READS])
            )
            rows = heapq.nsmallest(limit, [*rows, *(row for page in pages for row in page)], key=lambda row: row.key)
        return [records.read(row, Trial) for row in rows]

    async def _page(self, device: Device, after: str, limit: int) -> Sequence[Row]:
        rows: list[Row] = []
        partition, first = f"{device.id}/{device.pairing}", after + "\0" if after else ""
        cursor = None
        while len(rows) < limit:
            size = min(limit - len(rows), _MAX_PAGE)
            page = await self._tables.query(records.TRIALS, partition, first=first, limit=size, cursor=cursor)
            rows += page.rows
            cursor = page.cursor
            if cursor is None:
                break
        return rows

    async def add_batch(self, account: str, robot_type: str, batch: TrialBatch) -> TrialBatch:
        """Store a published batch of an account."""
        now_ms = self._clock.now_ms()
        due_ms = now_ms + KEEP_MS
        stored = replace(batch, key=f"{batch.task}:{new_suffix(now_ms)}", published_ms=now_ms, expires_ms=due_ms)
        partition = _batches(account, robot_type)
        await self._retention.delete_row_at(records.TRIALS, partition, stored.key, due_ms=due_ms)
        await self._tables.create(records.TRIALS, Row(partition, stored.key, records.to_data(stored)))
        return stored

    async def batches(self, account: str, robot_type: str, task: str, *, limit: int) -> list[TrialBatch]:
        """The newest batches of a task that an account has published."""
        page = await self._tables.query(
            records.TRIALS, _batches(account, robot_type), first=f"{task}:", last=f"{task};", limit=limit
        )
        return [records.read(row, TrialBatch) for row in page.rows]


def key_of(trial: Trial) -> str:
    """Key of a trial, for ``TrialLog.read``."""
    return _key(trial.action)


def trial_of(action: Action) -> Trial | None:
    """The trial that an action runs or has run; ``None``: it has not started, or was rejected."""
    report = _report(action) if action.status.terminal and not is_lost(action) else None
    open_ = not action.status.terminal and action.status is not Status.UNKNOWN
    started = Status.STARTED.value in action.times
    possible = action.status is Status.UNKNOWN or is_lost(action)
    if report is None and not started and not possible:
        return None
    trial = Trial(
        action=action.id,
        device=action.device,
        robot_type=str(action.pinned["robot_type"]),
        task=str(action.request["name"]),
        movement=str(action.request["movement"]),
        movement_version=int(action.pinned["version"]),
        tasks_sha256=str(action.request["tasks_sha256"]),
        seed=action.request["seed"],
        epoch=action.epoch,
        caller=action.caller,
        started_ms=action.issued_ms,
    )
    if open_:
        return trial
    if report is None:
        return replace(
            trial, ended_ms=action.ended_ms, state="unknown", cause=TrialCause.LOST.value, detail=NOT_REPORTED
        )
    return replace(
        trial,
        ended_ms=action.ended_ms,
        state=report.verdict.value,
        cause=report.cause.value,
        detail=report.detail,
        duration_s=report.duration_s,
        simulated=report.simulated,
        software=report.software,
        type_version=report.type_version,
    )


def _report(action: Action) -> TrialReport | None:
    """The report of the agent; ``None``: there is none, or it is not valid."""
    try:
        return msgspec.convert(action.result.get("trial"), TrialReport)
    except msgspec.ValidationError:
        return None


def _key(action: str) -> str:
    return (split_command(action) or ("", action))[1]


def _batches(account: str, robot_type: str) -> str:
    return f"batches/{account}/{robot_type}"
