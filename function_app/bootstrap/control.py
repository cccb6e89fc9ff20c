"""Factories of the control services."""

from functools import cached_property

from function_app.bootstrap.messaging import MessagingServices
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.control_requests import ControlRequests
from function_app.services.control.fencing import ControlRevocation
from function_app.services.control.lease_store import LeaseStore
from function_app.services.control.leases import Leases
from function_app.services.control.mqtt_credentials import MqttCredentials


class ControlServices(MessagingServices):
    """Creates each control service on first use."""

    @cached_property
    def control_events(self) -> ControlEvents:
        return ControlEvents(
            tables=self.tables,
            events=self.events,
            sessions=self.sessions_of_devices,
            audit_log=self.audit_log,
            reminders=self.reminders,
            metrics=self.metrics,
            clock=self.clock,
        )

    @cached_property
    def lease_store(self) -> LeaseStore:
        return LeaseStore(
            tables=self.tables, control_events=self.control_events, tracing=self.tracing, clock=self.clock
        )

    @cached_property
    def revocation(self) -> ControlRevocation:
        return ControlRevocation(
            tables=self.tables, command_sender=self.command_sender, access=self.access, clock=self.clock
        )

    @cached_property
    def leases(self) -> Leases:
        return Leases(
            tables=self.tables,
            devices=self.devices,
            lease_store=self.lease_store,
            revocation=self.revocation,
            command_sender=self.command_sender,
            control_events=self.control_events,
            keys=self.keys,
            clock=self.clock,
        )

    @cached_property
    def control_requests(self) -> ControlRequests:
        return ControlRequests(
            tables=self.tables,
            devices=self.devices,
            leases=self.leases,
            revocation=self.revocation,
            lease_store=self.lease_store,
            command_sender=self.command_sender,
            control_events=self.control_events,
            clock=self.clock,
        )

    @cached_property
    def mqtt_credentials(self) -> MqttCredentials:
        return MqttCredentials(
            tables=self.tables,
            devices=self.devices,
            access=self.access,
            control_events=self.control_events,
            clock=self.clock,
        )
