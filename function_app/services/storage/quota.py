"""Limits for stored bytes: of an account, of a device, and of the disk.

Each stored blob has a row in the partition of its account. One more row has the sums. Both change in one batch, so the
sums are exact after any interruption and below the limits with any number of concurrent requests.
"""

import asyncio
import logging
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final
from weakref import WeakKeyDictionary, WeakValueDictionary

from function_app.domain.common.problems import Problem
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables, Write
from function_app.services.storage import records

DAY_MS = 86_400_000
MB = 1_000_000
_TOTALS: Final = ":totals"
_AFTER_TOTALS: Final = ";"
"""Key of the sums, and the first key behind it. All names of blobs begin with a letter."""
_ACCOUNT_PREFIXES = ("movements", "robot-types", "recordings")
"""Blob names that continue with the account."""

_locks: WeakKeyDictionary[Tables, WeakValueDictionary[str, asyncio.Lock]] = WeakKeyDictionary()
"""Store → account → lock: the writes of one process do not conflict with each other."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class StorageLimits:
    """Limits of stored data.

    Attributes:
        account_bytes: Captures and recordings of all devices, scripts and robot types of an account.
        device_bytes: Captures and recordings of a device.
        series_bytes: Received measurements of a device in a day (UTC), counted by each process.
        min_free_bytes: Free disk space that remains for control: commands, leases, events and the audit log.
    """

    account_bytes: int
    device_bytes: int
    series_bytes: int
    min_free_bytes: int


@dataclass(frozen=True, slots=True)
class Usage:
    """Stored bytes of an account, and of its devices with captures or recordings [bytes]."""

    total_bytes: int = 0
    device_bytes: dict[str, int] = field(default_factory=dict)

    def plus(self, size: int, device: str) -> "Usage":
        """The usage with ``size`` more bytes [bytes], which may be negative, of a ``device`` (empty: of none)."""
        devices = dict(self.device_bytes)
        if device:
            devices[device] = devices.get(device, 0) + size
        return Usage(max(0, self.total_bytes + size), {name: used for name, used in devices.items() if used > 0})


@dataclass(frozen=True, slots=True)
class _Blob:
    """The row of a blob: its size [bytes], and its device (empty: none)."""

    bytes: int
    device: str = ""


class StorageQuota:
    """Admits new data, and counts it until it is deleted.

    Args:
        tables: Tables.
        limits: Limits.
        free_bytes: Free disk space [bytes]; ``None`` for a store without a fixed size.
        clock: Clock.
    """

    def __init__(
        self, *, tables: Tables, limits: StorageLimits, free_bytes: Callable[[], int | None], clock: Clock
    ) -> None:
        self.limits = limits
        self.free_bytes = free_bytes
        self._tables = tables
        self._clock = clock
        self._series: dict[str, int] = defaultdict(int)
        self._day = 0
        self._reported: set[str] = set()

    async def reserve(self, account: str, blob: str, size: int, *, device: str = "") -> None:
        """Count a blob of ``size`` [bytes] before it is written. Idempotent.

        Raises:
            Problem: ``storage-full``, ``quota-exceeded``, ``busy``.
        """
        await self.reserve_all(account, {blob: size}, device=device)

    async def reserve_all(self, account: str, sizes: Mapping[str, int], *, device: str = "") -> None:
        """Like ``reserve``, for blobs that are admitted or rejected together, with their sizes [bytes].

        Raises:
            Problem: ``storage-full``, ``quota-exceeded``, ``busy``.
        """
        if self._disk_is_full(sum(sizes.values())):
            detail = "The server's disk is almost full. Robots can be operated, but no data is stored. Free disk space."
            raise Problem("storage-full", 507, "The disk is full", detail)
        blobs = {name: _Blob(size, device) for name, size in sizes.items()}
        await _store(self._tables, account, blobs, lambda before, after: self._admit(before, after, device))

    async def usage(self, account: str) -> Usage:
        """The stored bytes of an account."""
        return (await _find(self._tables, account))[1]

    def _admit(self, before: Usage, after: Usage, device: str) -> None:
        for used_bytes, wanted_bytes, limit_bytes, owner in (
            (before.total_bytes, after.total_bytes, self.limits.account_bytes, "this account"),
            (
                before.device_bytes.get(device, 0),
                after.device_bytes.get(device, 0),
                self.limits.device_bytes,
                "this device",
            ),
        ):
            if wanted_bytes > limit_bytes:
                detail = (
                    f"{(wanted_bytes - used_bytes) / MB:.1f} MB do not fit: {used_bytes / MB:.1f} MB of the "
                    f"{limit_bytes / MB:.0f} MB for {owner} are in use. Delete captures, recordings, movements or "
                    "robot types that are not needed."
                )
                extras = {"used_bytes": used_bytes, "limit_bytes": limit_bytes}
                raise Problem("quota-exceeded", 413, "No storage left", detail, extras=extras)

    def refuse_measurement(self, device: str, size: int) -> str:
        """Count a measurement; returns the reason if it cannot be stored, otherwise an empty string."""
        day = self._clock.now_ms() // DAY_MS
        if day != self._day:
            self._day = day
            self._series.clear()
            self._reported.clear()
        if self._disk_is_full(size):
            return self._report("", "the server's disk is almost full; measurements are not stored")
        if self._series[device] + size > self.limits.series_bytes:
            limit_mb = self.limits.series_bytes / MB
            reason = f"{device} has sent {limit_mb:.0f} MB today; its measurements are not stored until midnight (UTC)"
            return self._report(device, reason)
        self._series[device] += size
        return ""

    def _disk_is_full(self, size: int) -> bool:
        free = self.free_bytes()
        return free is not None and free - size < self.limits.min_free_bytes

    def _report(self, cause: str, reason: str) -> str:
        """Log each cause once a day."""
        if cause not in self._reported:
            self._reported.add(cause)
            _log.error("%s", reason)
        return reason


async def release(tables: Tables, account: str, blob: str) -> None:
    """Stop counting a deleted blob. Idempotent.

    Raises:
        Problem: ``busy``: other requests changed the sums in the meantime.
    """
    await _store(tables, account, {blob: None})


async def release_owned(tables: Tables, blob: str) -> None:
    """Like ``release``, for a blob whose name contains its account. Raises ``busy``."""
    match blob.split("/", 2):
        case [prefix, account, _] if prefix in _ACCOUNT_PREFIXES:
            await release(tables, account, blob)


async def _store(
    tables: Tables,
    account: str,
    blobs: Mapping[str, _Blob | None],
    admit: Callable[[Usage, Usage], None] = lambda _before, _after: None,
) -> None:
    """Store the rows of blobs (``None``: the blob is deleted) with the new sums.

    ``admit`` gets the former and the new sums, and may raise a ``Problem``. Also raises ``busy``.
    """

    async def attempt() -> None:
        row, before = await _find(tables, account)
        after, writes = before, []
        for name, blob in blobs.items():
            existing, former = await records.find(tables, records.USAGE, account, name, _Blob)
            if former == blob:
                continue
            if former is not None:
                after = after.plus(-former.bytes, former.device)
            if blob is not None:
                after = after.plus(blob.bytes, blob.device)
                writes.append(records.write(existing, account, name, records.to_data(blob)))
            elif existing is not None:
                writes.append(Write("delete", existing))
        if not writes:
            return
        if after.total_bytes > before.total_bytes:
            admit(before, after)
        writes.append(records.write(row, account, _TOTALS, records.to_data(after)))
        await tables.batch(records.USAGE, writes)

    locks = _locks.setdefault(tables, WeakValueDictionary())
    async with locks.setdefault(account, asyncio.Lock()):
        await records.retry(attempt)


async def _find(tables: Tables, account: str) -> tuple[Row | None, Usage]:
    """The sums of an account, and their row. Former versions stored no sums, so they are counted once."""
    row, usage = await records.find(tables, records.USAGE, account, _TOTALS, Usage)
    if usage is None:
        usage = Usage()
        async for blob in records.all_rows(tables, records.USAGE, account, first=_AFTER_TOTALS):
            usage = usage.plus(blob.data["bytes"], blob.data["device"])
    return row, usage
