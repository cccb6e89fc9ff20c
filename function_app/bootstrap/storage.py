"""Factories of the storage services."""

from functools import cached_property

from function_app.bootstrap.ports import Ports
from function_app.services.storage.quota import MB, StorageLimits, StorageQuota
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import Retention


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
