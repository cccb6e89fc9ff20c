"""Factories of the audit services."""

from functools import cached_property

from function_app.bootstrap.storage import StorageServices
from function_app.services.audit.audit_log import AuditLog
from function_app.services.audit.audit_reader import AuditReader


class AuditServices(StorageServices):
    """Creates each audit service on first use."""

    @cached_property
    def audit_log(self) -> AuditLog:
        return AuditLog(
            tables=self.tables,
            blobs=self.blobs,
            keys=self.keys,
            retention=self.retention,
            reminders=self.reminders,
            clock=self.clock,
        )

    @cached_property
    def audit_reader(self) -> AuditReader:
        return AuditReader(tables=self.tables, blobs=self.blobs, keys=self.keys)
