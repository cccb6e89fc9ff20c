"""Factories of the maintenance services."""

from functools import cached_property

from function_app import VERSION
from function_app.bootstrap.accounts import AccountServices
from function_app.services.maintenance.heartbeats import Heartbeats
from function_app.services.maintenance.readiness import ReadinessCheck
from function_app.services.maintenance.restored_backup import RestoredBackup
from function_app.services.maintenance.scheduler import Scheduler
from function_app.services.robot_types.cleanup import RobotTypeCleanup
from function_app.services.storage.retention import DAY_MS


class MaintenanceServices(AccountServices):
    """Creates each maintenance service on first use."""

    @cached_property
    def scheduler(self) -> Scheduler:
        return Scheduler(
            tables=self.tables,
            action_store=self.action_store,
            reminders=self.reminders,
            command_sender=self.command_sender,
            dispatcher=self.dispatcher,
            queues=self.queues,
            offboarding=self.offboarding,
            sharing=self.sharing,
            invitations=self.invitations,
            api_keys=self.api_keys,
            control_events=self.control_events,
            session_actions=self.session_actions,
            trial_log=self.trial_log,
            audit_log=self.audit_log,
            access=self.access,
            retention=self.retention,
            reported_faults=self.reported_faults,
            telemetry_ingest=self.telemetry_ingest,
            uploads=self.uploads,
            robot_types=RobotTypeCleanup(tables=self.tables, blobs=self.blobs, clock=self.clock),
            keep_actions_ms=self.settings.retention.actions_days * DAY_MS,
            clock=self.clock,
        )

    @cached_property
    def restored_backup(self) -> RestoredBackup:
        return RestoredBackup(
            tables=self.tables,
            action_store=self.action_store,
            queues=self.queues,
            reminders=self.reminders,
            audit_log=self.audit_log,
            audit_reader=self.audit_reader,
            clock=self.clock,
        )

    @cached_property
    def heartbeats(self) -> Heartbeats:
        return Heartbeats(tables=self.tables, clock=self.clock, version=VERSION)

    @cached_property
    def health(self) -> ReadinessCheck:
        return ReadinessCheck(
            tables=self.tables,
            blobs=self.blobs,
            bus=self.bus,
            heartbeats=self.heartbeats,
            free_bytes=self.adapters.free_bytes,
            min_free_bytes=self.quota.limits.min_free_bytes,
            subscribes=self.settings.bus is None,
            clock=self.clock,
        )
