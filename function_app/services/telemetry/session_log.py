"""Sessions of devices, newest first. A session is a lease from its grant to its end."""

from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import replace
from typing import Any, Final

import msgspec

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.events import Activity
from function_app.domain.control.control_events import Fact
from function_app.domain.devices.devices import Device
from function_app.domain.telemetry.sessions import BEGINNINGS, ENDS, Session
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS, Retention

KEEP_SESSIONS_MS: Final = 730 * DAY_MS
"""Time that sessions are stored after their last change [ms]."""
_CACHE_SIZE: Final = 4_096
"""Scheduled deletions that this process remembers."""
_NEXT_EPOCHS: Final = 100
"""Epochs in which the next session is searched: a reset of Stop uses an epoch without a session."""
_MAX_EPOCH: Final = 10**16 - 1
"""More than any epoch, so that keys count down."""


class SessionLog:
    """Stores the sessions of all devices."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock
        self._noted: set[tuple[str, str, int]] = set()

    async def add_control_event(self, device: str, pairing: str, event: Mapping[str, Any]) -> None:
        """Add a control event of the cloud to the session that it starts or ends. Idempotent. Raises ``busy``."""
        kind, at_ms, data = event["kind"], event["at_ms"], event["data"]
        epoch = data.get("ended_epoch", None if kind == Fact.RESET_ORDERED else data.get("epoch"))
        if kind in BEGINNINGS | ENDS and epoch is not None:
            await self._change(device, pairing, epoch, lambda session: session.with_control(kind, at_ms, data))

    async def add_activity(self, device: str, pairing: str, data: Mapping[str, Any]) -> None:
        """Add the sums of an agent's ``activity`` event. Idempotent.

        Raises:
            ProtocolError: A field is missing or invalid.
            Problem: ``busy``.
        """
        try:
            activity = msgspec.convert(data, Activity)
        except msgspec.ValidationError as error:
            raise ProtocolError(f"not an activity: {error}") from error
        await self._change(
            device,
            pairing,
            activity.epoch,
            lambda session: session.with_activity(activity.operator_s, activity.machine_s, activity.first_input_s),
        )

    async def add_action(self, device: str, pairing: str, epoch: int, action: str, **result: Any) -> None:
        """Add the result of an ended action to the session of its epoch, unless a person has this lease. Idempotent.

        Args:
            device: Device id.
            pairing: Pairing of the action.
            epoch: Epoch of the action.
            action: Id of the action.
            result: Arguments of ``Session.with_action``.

        Raises:
            Problem: ``busy``.
        """
        await self._change(
            device,
            pairing,
            epoch,
            lambda session: session.with_action(**result) if session.action == action else session,
        )

    async def read(self, device: Device, *, cursor: str | None = None, limit: int) -> tuple[list[Session], str | None]:
        """Sessions since the pairing, newest first, and the cursor of the next page. Raises ``cursor-invalid``."""
        partition = _partition(device.id, device.pairing)
        page = await records.page(self._tables, records.SESSIONS, partition, cursor=cursor, limit=limit)
        return [records.read(row, Session) for row in page.rows], page.cursor

    async def get(self, device: Device, epoch: int) -> Session | None:
        """The session of an epoch; ``None``: there is none since the pairing."""
        partition = _partition(device.id, device.pairing)
        return (await records.find(self._tables, records.SESSIONS, partition, _key(epoch), Session))[1]

    async def since(self, device: Device, first_ms: int) -> AsyncIterator[Session]:
        """Sessions that changed at or after ``first_ms`` [ms since 1970] and whose start is known, newest first."""
        async for row in records.all_rows(self._tables, records.SESSIONS, _partition(device.id, device.pairing)):
            session = records.read(row, Session)
            # Without the cloud's own event of the start, the epoch is only the claim of an agent.
            if session.started_ms and session.seen_ms < first_ms:
                return
            if session.started_ms:
                yield session

    async def next_start_ms(self, device: Device, session: Session) -> int:
        """When the session after this one started [ms since 1970]; 0: not among the next epochs."""
        partition, epoch = _partition(device.id, device.pairing), session.epoch
        first, last = _key(epoch + _NEXT_EPOCHS), _key(epoch)
        page = await self._tables.query(records.SESSIONS, partition, first=first, last=last, limit=_NEXT_EPOCHS)
        starts = [records.read(row, Session).started_ms for row in page.rows]
        return next((started_ms for started_ms in reversed(starts) if started_ms), 0)

    async def _change(self, device: str, pairing: str, epoch: int, change: Callable[[Session], Session]) -> None:
        partition, key = _partition(device, pairing), _key(epoch)

        async def attempt() -> None:
            row, existing = await records.find(self._tables, records.SESSIONS, partition, key, Session)
            before = existing or Session(epoch)
            after = change(before)
            if after == before:
                return
            now_ms = self._clock.now_ms()
            await self._schedule_deletion(partition, key, now_ms // DAY_MS)
            data = records.to_data(replace(after, seen_ms=now_ms, expires_ms=now_ms + KEEP_SESSIONS_MS))
            await self._tables.batch(records.SESSIONS, [records.write(row, partition, key, data)])

        await records.retry(attempt)

    async def _schedule_deletion(self, partition: str, key: str, day: int) -> None:
        """Schedule one deletion for all changes of a session on one day."""
        if (partition, key, day) in self._noted:
            return
        due_ms = (day + 1) * DAY_MS + KEEP_SESSIONS_MS
        await self._retention.delete_row_at(records.SESSIONS, partition, key, due_ms=due_ms)
        if len(self._noted) >= _CACHE_SIZE:
            self._noted.clear()
        self._noted.add((partition, key, day))


def _key(epoch: int) -> str:
    return f"{_MAX_EPOCH - epoch:016d}"


def _partition(device: str, pairing: str) -> str:
    return f"{device}/{pairing}"
