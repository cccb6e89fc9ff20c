"""Fault records of devices, with at most one open fault per code.

Partition of ``Faults``: device and pairing. Keys: ``open:<scope>:<code>``; ``past:<id>``, newest first; ``count:…``,
number of faults with a code; ``event:<id>:<step>``, an event to publish, written in the same batch as the step.
"""

from collections.abc import Sequence
from typing import Any

import msgspec

from function_app.domain.common.ids import new_suffix
from function_app.domain.common.problems import Problem, not_found
from function_app.domain.devices.devices import Device
from function_app.domain.health import faults as rules
from function_app.domain.health.faults import Fault, Report, Severity
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables, Write
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS, Retention
from function_app.services.telemetry.event_log import EventLog

KEEP_FAULTS_MS = 365 * DAY_MS
"""Time that cleared faults and counts are stored."""
MAX_OPEN = 64
"""Maximum number of open faults per scope; further ones are ignored."""
_OPEN, _PAST, _COUNT, _EVENT = "open:", "past:", "count:", "event:"
_CODE_SHOWN = 200


class Faults:
    """Raises, acknowledges and clears faults."""

    def __init__(self, *, tables: Tables, events: EventLog, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._events = events
        self._retention = retention
        self._clock = clock

    async def settle(self, device: Device, scope: str, reports: Sequence[Report]) -> None:
        """Make the open faults of a scope equal to ``reports``: raise new ones, clear missing ones. Idempotent.

        ``reports`` are all current faults of one reporter, the ``scope``. Raises ``busy``.
        """
        current = {_key(scope, report.code): report for report in list(reports)[:MAX_OPEN]}

        async def attempt() -> bool:
            rows = await self._read(device)
            existing = {row.key: row for row in rows if row.key.startswith(f"{_OPEN}{scope}:")}
            changed = any(row.key.startswith(_EVENT) for row in rows)
            for key, row in existing.items():
                if key not in current:
                    await self._clear(device, row)
                    changed = True
            for key, report in current.items():
                changed |= await self._report(device, key, report, existing.get(key))
            return changed

        if await records.retry(attempt):
            await self._publish_events(device)

    async def open(self, device: Device) -> list[Fault]:
        """Open faults, worst first, then newest first."""
        rows = await self._read(device)
        result = [records.read(row, Fault) for row in rows if row.key.startswith(_OPEN)]
        return sorted(result, key=lambda fault: (-fault.severity.rank, fault.id))

    async def past(self, device: Device, *, cursor: str | None, limit: int) -> tuple[list[Fault], str | None]:
        """Cleared faults, newest first. Raises ``cursor-invalid``."""
        page = await records.page(
            self._tables, records.FAULTS, _partition(device), first=_PAST, last="past;", limit=limit, cursor=cursor
        )
        return [records.read(row, Fault) for row in page.rows], page.cursor

    async def acknowledge(self, device: Device, fault: str, *, by: str) -> Fault:
        """Acknowledge a fault; it stays open until it is cleared.

        Raises ``fault-unknown``, ``fault-cleared`` or ``busy``.
        """

        async def attempt() -> Fault:
            rows = [row for row in await self._read(device) if row.key.startswith(_OPEN)]
            row = next((row for row in rows if row.data["id"] == fault), None)
            if row is None:
                if await self._tables.get(records.FAULTS, _partition(device), f"{_PAST}{fault[:64]}") is None:
                    raise not_found("fault", fault)
                raise Problem(
                    "fault-cleared", 409, "The fault is cleared", "It was cleared and needs no acknowledgement."
                )
            existing = records.read(row, Fault)
            seen = rules.acknowledged(existing, by=by, now_ms=self._clock.now_ms())
            if seen is not existing:
                write = Write("replace", row.changed(records.to_data(seen)))
                await self._write(device, seen, "acknowledged", [write])
            return seen

        result = await records.retry(attempt)
        await self._publish_events(device)
        return result

    async def _read(self, device: Device) -> list[Row]:
        """Open faults, and events to publish."""
        page = await self._tables.query(records.FAULTS, _partition(device), first=_EVENT, last="open;", limit=1000)
        return list(page.rows)

    async def _report(self, device: Device, key: str, report: Report, row: Row | None) -> bool:
        """Raise a fault, count its occurrences or increase its severity; return whether there is an event."""
        partition, now_ms = _partition(device), self._clock.now_ms()
        if row is not None:
            existing = records.read(row, Fault)
            after = rules.reported(existing, report, now_ms=now_ms)
            if after is existing:
                return False
            write = Write("replace", row.changed(records.to_data(after)))
            worsened = after.worse > existing.worse
            if worsened:
                await self._write(device, after, f"worsened-{after.worse}", [write])
            else:  # a further occurrence of the same condition: no event
                await self._tables.batch(records.FAULTS, [write])
            return worsened
        count_key = _COUNT + key.removeprefix(_OPEN)
        counted = await self._tables.get(records.FAULTS, partition, count_key)
        count = counted.data["count"] + 1 if counted else 1
        fault = rules.raised(report, fault=new_suffix(now_ms), now_ms=now_ms, count=count)
        expires_ms = now_ms + KEEP_FAULTS_MS
        await self._retention.delete_row_at(records.FAULTS, partition, count_key, due_ms=expires_ms)
        writes = [
            Write("create", Row(partition, key, records.to_data(fault))),
            records.write(counted, partition, count_key, {"count": count, "expires_ms": expires_ms}),
        ]
        await self._write(device, fault, "raised", writes)
        return True

    async def _clear(self, device: Device, row: Row) -> None:
        now_ms = self._clock.now_ms()
        over = rules.cleared(records.read(row, Fault), now_ms=now_ms)
        past = Row(row.partition, f"{_PAST}{over.id}", records.to_data(over))
        await self._retention.delete_row_at(records.FAULTS, row.partition, past.key, due_ms=now_ms + KEEP_FAULTS_MS)
        await self._write(device, over, "cleared", [Write("delete", row), Write("create", past)])

    async def _write(self, device: Device, fault: Fault, step: str, writes: list[Write]) -> None:
        """Write one step of a fault with its event."""
        event = Row(_partition(device), f"{_EVENT}{fault.id}:{step}", _event(device, fault, step, self._clock.now_ms()))
        await self._tables.batch(records.FAULTS, [*writes, Write("create", event)])

    async def _publish_events(self, device: Device) -> None:
        page = await self._tables.query(records.FAULTS, _partition(device), first=_EVENT, last="event;", limit=1000)
        for row in page.rows:
            await self._events.add(device.id, device.pairing, row.data)
            try:
                await self._tables.delete(records.FAULTS, row)
            except Conflict:
                continue  # another process publishes the same event


def _event(device: Device, fault: Fault, step: str, now_ms: int) -> dict[str, Any]:
    kind = step.partition("-")[0]
    severity = fault.severity if kind in {"raised", "worsened"} else Severity.INFO
    return {
        "id": f"{fault.id}-{step}",
        "device": device.name,
        "at_ms": now_ms,
        "kind": f"fault-{kind}",
        "severity": severity.value,
        "message": fault.message,
        "data": msgspec.to_builtins(fault),
    }


def _key(scope: str, code: str) -> str:
    return f"{_OPEN}{scope}:{code[:_CODE_SHOWN]}"


def _partition(device: Device) -> str:
    return f"{device.id}/{device.pairing}"
