"""Current viewers of a device: open pages report periodically and get the list of other viewers.

One row per sign-in session expires after a few seconds, so closed pages and callers without permission disappear. No
other function depends on it.
"""

import contextlib
from dataclasses import dataclass
from typing import Final

from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity, Role
from function_app.ports.clock import Clock
from function_app.ports.tables import MAX_BATCH, Conflict, Row, Tables, Write
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.storage import records
from function_app.services.storage.retention import Retention

VALID_MS: Final = 25_000
"""Validity of a report [ms]; pages report every ten seconds."""
MAX_VIEWERS: Final = 50
"""Maximum number of viewers per device; further viewers see the list but are not in it."""
_MIN_INTERVAL_MS: Final = 5_000
"""Minimum interval between stored reports of a session [ms]."""
_DELETE_INTERVAL_MS: Final = 3_600_000


@dataclass(frozen=True, slots=True)
class Viewer:
    """A sign-in session that views a device: since when without interruption, and its last report."""

    account: str
    session: str
    name: str
    role: Role
    since_ms: int
    said_ms: int
    expires_ms: int
    pairing: str


class Viewers:
    """Tracks the viewers of devices."""

    def __init__(self, *, tables: Tables, devices: DeviceAccess, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._devices = devices
        self._retention = retention
        self._clock = clock

    async def mark(self, caller: Identity, device_id: str) -> list[Viewer]:
        """Report that ``caller`` views a device; return the other viewers, longest first. Raises ``device-unknown``."""
        device = await self._devices.get(caller, device_id)
        now_ms = self._clock.now_ms()
        page = await self._tables.query(records.WATCHERS, device.id, limit=2 * MAX_VIEWERS)
        rows = {row.key: (row, records.read(row, Viewer)) for row in page.rows}
        live = {
            key: existing
            for key, (_, existing) in rows.items()
            if existing.expires_ms > now_ms and existing.pairing == device.pairing
        }
        mine = live.get(caller.session)
        if mine is None and len(live) < MAX_VIEWERS:
            await self._delete_expired([row for key, (row, _) in rows.items() if key not in live])
        if (len(live) < MAX_VIEWERS) if mine is None else now_ms - mine.said_ms >= _MIN_INTERVAL_MS:
            await self._store(device, caller, now_ms)
        others = [existing for key, existing in live.items() if key != caller.session]
        return sorted(others, key=lambda existing: existing.since_ms)

    async def leave(self, caller: Identity, device_id: str) -> None:
        """Report that ``caller`` stopped viewing. Raises ``device-unknown``."""
        device = await self._devices.get(caller, device_id)
        await records.remove(self._tables, records.WATCHERS, device.id, caller.session)

    async def _store(self, device: Device, caller: Identity, now_ms: int) -> None:
        # One deletion per hour, scheduled before the row is written.
        due_ms = (now_ms // _DELETE_INTERVAL_MS + 2) * _DELETE_INTERVAL_MS
        await self._retention.delete_rows_at(records.WATCHERS, device.id, first="", last=None, due_ms=due_ms)

        def updated(existing: Viewer | None) -> Viewer:
            continues = existing is not None and existing.expires_ms > now_ms and existing.pairing == device.pairing
            since_ms = existing.since_ms if existing is not None and continues else now_ms
            return Viewer(
                account=caller.account,
                session=caller.session,
                name=caller.name,
                role=device.role,
                since_ms=since_ms,
                said_ms=now_ms,
                expires_ms=now_ms + VALID_MS,
                pairing=device.pairing,
            )

        await records.upsert(self._tables, records.WATCHERS, device.id, caller.session, updated, Viewer)

    async def _delete_expired(self, expired: list[Row]) -> None:
        """Delete expired rows of a device."""
        if expired:
            with contextlib.suppress(Conflict):  # deleted by another process
                await self._tables.batch(records.WATCHERS, [Write("delete", row) for row in expired[:MAX_BATCH]])
