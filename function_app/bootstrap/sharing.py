"""Factories of the sharing services."""

from functools import cached_property

from function_app.bootstrap.pairing import PairingServices
from function_app.services.sharing.access_revocation import AccessRevocation
from function_app.services.sharing.invitations import Invitations
from function_app.services.sharing.ownership_transfer import OwnershipTransfer
from function_app.services.sharing.shares import Sharing


class SharingServices(PairingServices):
    """Creates each sharing service on first use."""

    @cached_property
    def sharing(self) -> Sharing:
        return Sharing(
            tables=self.tables,
            devices=self.devices,
            spaces=self.spaces,
            sign_in=self.sign_in,
            access_revocation=AccessRevocation(
                tables=self.tables,
                devices=self.devices,
                action_store=self.action_store,
                queues=self.queues,
                command_sender=self.command_sender,
                revocation=self.revocation,
                access=self.access,
                clock=self.clock,
            ),
            reminders=self.reminders,
            control_events=self.control_events,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def invitations(self) -> Invitations:
        return Invitations(
            tables=self.tables,
            sharing=self.sharing,
            ownership_transfer=OwnershipTransfer(
                tables=self.tables,
                devices=self.devices,
                sharing=self.sharing,
                offboarding=self.offboarding,
                clock=self.clock,
            ),
            sign_in=self.sign_in,
            reminders=self.reminders,
            retention=self.retention,
            audit_log=self.audit_log,
            clock=self.clock,
        )
