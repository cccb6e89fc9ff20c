"""Limits for stored bytes: of an account, of a device, and of the disk.

Each stored blob has a row in the partition of its account, so that the sum is exact after any interruption. A row is
written before the sum is compared with the limit: concurrent requests may both be rejected, but never exceed it.
"""

import logging
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from function_app.domain.common.problems import Problem
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.storage import records

DAY_MS = 86_400_000
MB = 1_000_000
_PAGE = 1_000
_ACCOUNT_PREFIXES = ("movements", "robot-types", "recordings")
"""Blob names that continue with the account."""

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


@dataclass(slots=True)
class Usage:
    """Stored bytes of an account, and of its devices with captures or recordings."""

    total_bytes: int = 0
    device_bytes: dict[str, int] = field(default_factory=lambda: defaultdict(int))


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
        """Count a blob before it is written. Idempotent.

        Raises:
            Problem: ``storage-full``, ``quota-exceeded``.
        """
        await self.reserve_all(account, {blob: size}, device=device)

    async def reserve_all(self, account: str, sizes: Mapping[str, int], *, device: str = "") -> None:
        """Like ``reserve``, for blobs that are admitted or rejected together, with their sizes [bytes].

        Raises:
            Problem: ``storage-full``, ``quota-exceeded``.
        """
        size = sum(sizes.values())
        if self._disk_is_full(size):
            detail = "The server's disk is almost full. Robots can be operated, but no data is stored. Free disk space."
            raise Problem("storage-full", 507, "The disk is full", detail)
        for blob, length in sizes.items():
            await self._count(account, blob, {"bytes": length, "device": device})
        usage = await self.usage(account)
        for used_bytes, limit_bytes, owner in (
            (usage.total_bytes, self.limits.account_bytes, "this account"),
            (usage.device_bytes[device] if device else 0, self.limits.device_bytes, "this device"),
        ):
            if used_bytes > limit_bytes:
                for blob in sizes:
                    await release(self._tables, account, blob)
                detail = (
                    f"{size / MB:.1f} MB do not fit: {(used_bytes - size) / MB:.1f} MB of the {limit_bytes / MB:.0f} "
                    f"MB for {owner} are in use. Delete captures, recordings, movements or robot types that are not "
                    "needed."
                )
                extras = {"used_bytes": used_bytes - size, "limit_bytes": limit_bytes}
                raise Problem("quota-exceeded", 413, "No storage left", detail, extras=extras)

    async def usage(self, account: str) -> Usage:
        """The stored bytes of an account."""
        result, cursor = Usage(), None
        while True:
            page = await self._tables.query(records.USAGE, account, limit=_PAGE, cursor=cursor)
            for row in page.rows:
                result.total_bytes += row.data["bytes"]
                if row.data["device"]:
                    result.device_bytes[row.data["device"]] += row.data["bytes"]
            cursor = page.cursor
            if cursor is None:
                return result

    async def _count(self, account: str, blob: str, data: dict[str, Any]) -> None:
        await records.upsert(self._tables, records.USAGE, account, blob, lambda _: data, dict)

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
    """Stop counting a deleted blob. Idempotent."""
    await records.remove(tables, records.USAGE, account, blob)


async def release_owned(tables: Tables, blob: str) -> None:
    """Like ``release``, for a blob whose name contains its account."""
    match blob.split("/", 2):
        case [prefix, account, _] if prefix in _ACCOUNT_PREFIXES:
            await release(tables, account, blob)
