"""Factories of the storage services."""

from functools import cached_property

from function_app.bootstrap.ports import Ports
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import Retention


class StorageServices(Ports):
    """Creates each storage service on first use."""

    @cached_property
    def retention(self) -> Retention:
        return Retention(tables=self.tables, blobs=self.blobs)

    @cached_property
    def reminders(self) -> Reminders:
        return Reminders(tables=self.tables)
