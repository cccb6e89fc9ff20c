"""What happened to devices, newest first: told by agents, or found here."""

from collections.abc import Mapping
from typing import Any

from function_app.domain.ids import new_suffix
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services import store
from function_app.services.forget import DAY_MS, Forget

KEEP_EVENTS_MS = 90 * DAY_MS
_NOTED = 4096
"""Days of devices whose end a process knows to be noted."""


class Events:
    """The events of all devices."""

    def __init__(self, *, tables: Tables, forget: Forget, clock: Clock) -> None:
        self._tables = tables
        self._forget = forget
        self._clock = clock
        self._noted: dict[tuple[str, int, int], None] = {}

    async def add(self, device: str, event: Mapping[str, Any]) -> None:
        """Store an event by its ``id`` and ``at_ms``: one that comes twice is stored once."""
        now_ms = self._clock.now_ms()
        data = {**event, "seen_ms": now_ms, "expires_ms": now_ms + KEEP_EVENTS_MS}
        when = new_suffix(event["at_ms"])[:9]
        await self._note(device, event["at_ms"] // DAY_MS, now_ms // DAY_MS)
        try:
            await self._tables.create(store.EVENTS, Row(device, f"{when}:{event['id']}", data))
        except Conflict:
            return

    async def _note(self, device: str, day: int, seen_day: int) -> None:
        """See that the events of one day that were seen on another will be forgotten: one note for all of them."""
        known = (device, day, seen_day)
        if known in self._noted:
            return
        # Keys count down with time: the day's last moment comes first.
        first, last = (new_suffix((day + 1) * DAY_MS - 1)[:9], new_suffix(day * DAY_MS)[:9] + ";")
        due_ms = (seen_day + 1) * DAY_MS + KEEP_EVENTS_MS
        await self._forget.rows(store.EVENTS, device, first=first, last=last, due_ms=due_ms)
        self._noted[known] = None
        if len(self._noted) > _NOTED:
            del self._noted[next(iter(self._noted))]
