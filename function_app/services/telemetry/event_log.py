"""Events of devices, newest first."""

from collections.abc import Mapping
from typing import Any

from function_app.domain.common.ids import new_suffix, split_command
from function_app.domain.common.problems import invalid
from function_app.domain.devices.devices import Device
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS, Retention

KEEP_EVENTS_MS = 90 * DAY_MS
_NOTED = 4096
"""Cache of scheduled deletions, by device and day."""


class EventLog:
    """Stores the events of all devices."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock
        self._noted: dict[tuple[str, int, int], None] = {}

    async def add(self, device: str, pairing: str, event: Mapping[str, Any]) -> None:
        """Store an event. Idempotent by ``id`` and ``at_ms``.

        Args:
            device: Device id.
            pairing: Pairing of the event; later owners cannot read it.
            event: Fields of ``Event``.
        """
        partition = _partition(device, pairing)
        now_ms = self._clock.now_ms()
        data = {**event, "seen_ms": now_ms, "expires_ms": now_ms + KEEP_EVENTS_MS}
        when = new_suffix(event["at_ms"])[:9]
        await self._note(partition, event["at_ms"] // DAY_MS, now_ms // DAY_MS)
        try:
            await self._tables.create(records.EVENTS, Row(partition, f"{when}:{event['id']}", data))
        except Conflict:
            return

    async def command_age_ms(self, device: str, pairing: str, command: str) -> int | None:
        """How long ago the event of a command was stored, which has its id and time; ``None``: there is none."""
        parts = split_command(command)
        if parts is None or parts[0] != device:
            return None
        row = await self._tables.get(records.EVENTS, _partition(device, pairing), f"{parts[1][:9]}:{command}")
        return None if row is None else self._clock.now_ms() - int(row.data["seen_ms"])

    async def read(
        self, device: Device, *, cursor: str | None, limit: int
    ) -> tuple[list[Mapping[str, Any]], str | None]:
        """Events since the pairing, newest first, and the cursor of the next page.

        Raises:
            Problem: ``cursor-invalid``.
        """
        try:
            page = await self._tables.query(
                records.EVENTS, _partition(device.id, device.pairing), limit=limit, cursor=cursor
            )
        except ValueError as error:
            raise invalid(
                "The cursor is not valid for this list. Start without a cursor.", code="cursor-invalid"
            ) from error
        return [row.data for row in page.rows], page.cursor

    async def _note(self, partition: str, day: int, seen_day: int) -> None:
        """Schedule one deletion for all events of one day that arrived on another day."""
        existing = (partition, day, seen_day)
        if existing in self._noted:
            return
        # Keys decrease with time: the last moment of the day comes first.
        first, last = (new_suffix((day + 1) * DAY_MS - 1)[:9], new_suffix(day * DAY_MS)[:9] + ";")
        due_ms = (seen_day + 1) * DAY_MS + KEEP_EVENTS_MS
        await self._retention.delete_rows_at(records.EVENTS, partition, first=first, last=last, due_ms=due_ms)
        self._noted[existing] = None
        if len(self._noted) > _NOTED:
            del self._noted[next(iter(self._noted))]


def _partition(device: str, pairing: str) -> str:
    return f"{device}/{pairing}"
