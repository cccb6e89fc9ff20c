"""Factories of the pairing services."""

from functools import cached_property

from function_app.bootstrap.actions import ActionServices
from function_app.services.pairing.agent_certificates import AgentCertificates
from function_app.services.pairing.claim import Claim
from function_app.services.pairing.enroll import Enroll
from function_app.services.pairing.offboarding import Offboarding
from function_app.services.pairing.unpair import Unpair


class PairingServices(ActionServices):
    """Creates each pairing service on first use."""

    @cached_property
    def offboarding(self) -> Offboarding:
        return Offboarding(
            tables=self.tables,
            action_store=self.action_store,
            queues=self.queues,
            reminders=self.reminders,
            revocation=self.revocation,
            access=self.access,
            certificates=self.certificates,
            bus=self.bus,
            series=self.series_writer,
            recordings=self.recordings,
            retention=self.retention,
            control_events=self.control_events,
            clock=self.clock,
        )

    @cached_property
    def agent_certificates(self) -> AgentCertificates:
        return AgentCertificates(certificates=self.certificates)

    @cached_property
    def enroll(self) -> Enroll:
        return Enroll(tables=self.tables, offboarding=self.offboarding, retention=self.retention, clock=self.clock)

    @cached_property
    def claim(self) -> Claim:
        return Claim(
            tables=self.tables,
            sign_in=self.sign_in,
            guess_limiter=self.guess_limiter,
            offboarding=self.offboarding,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def unpair(self) -> Unpair:
        return Unpair(tables=self.tables, sign_in=self.sign_in, offboarding=self.offboarding, audit_log=self.audit_log)
