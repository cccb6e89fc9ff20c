"""The adapters as the ports that services take, and factories of the storage services."""

import asyncio
from functools import cached_property

from function_app.adapters.factory import Adapters
from function_app.ports.clock import Clock
from function_app.services.storage.quota import MB, StorageLimits, StorageQuota
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import Retention
from function_app.settings import Settings


class Ports:
    """Settings, clock and adapters of one installation."""

    def __init__(self, settings: Settings, adapters: Adapters, clock: Clock) -> None:
        self.settings = settings
        self.adapters = adapters
        self.clock = clock
        self.keys = adapters.keys
        self.tables = adapters.tables
        self.blobs = adapters.blobs
        self.access = adapters.access
        self.bus = adapters.bus
        self.certificates = adapters.certificates
        self.catalogue = adapters.catalogue
        self.transfers = adapters.transfers
        self.feed = adapters.feed
        self.telemetry = adapters.telemetry
        self.late = adapters.late
        self.metrics = adapters.metrics
        self.tracing = adapters.tracing

    async def close(self) -> None:
        """Close all connections."""
        for adapter in (self.bus, self.access, self.tables, self.blobs, self.keys, self.certificates):
            await adapter.close()
        if self.tracing.enabled:
            await asyncio.to_thread(self.tracing.close)


class StorageServices(Ports):
    """Creates each storage service on first use."""

    @cached_property
    def retention(self) -> Retention:
        return Retention(tables=self.tables, blobs=self.blobs)

    @cached_property
    def quota(self) -> StorageQuota:
        limits = self.settings.storage_limits
        return StorageQuota(
            tables=self.tables,
            limits=StorageLimits(
                account_bytes=limits.account_mb * MB,
                device_bytes=limits.device_mb * MB,
                series_bytes=limits.series_mb * MB,
                min_free_bytes=limits.min_free_mb * MB,
            ),
            free_bytes=self.adapters.free_bytes,
            clock=self.clock,
        )

    @cached_property
    def reminders(self) -> Reminders:
        return Reminders(tables=self.tables, clock=self.clock)
