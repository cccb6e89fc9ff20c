"""Factories of the messaging services."""

from functools import cached_property

from function_app.bootstrap.health import HealthServices
from function_app.services.messaging.broker_relay import BrokerRelay
from function_app.services.messaging.camera_consents import CameraConsents
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.confirmations import Confirmations
from function_app.services.messaging.delivery import Delivery
from function_app.services.messaging.key_announcer import KeyAnnouncer
from function_app.services.messaging.mailbox import Mailbox
from function_app.services.messaging.polling import CommandPolling
from function_app.services.messaging.presence import PresenceIngest
from function_app.services.messaging.xmpp_credentials import XmppCredentials


class MessagingServices(HealthServices):
    """Creates each messaging service on first use."""

    @cached_property
    def mailbox(self) -> Mailbox:
        return Mailbox(tables=self.tables, retention=self.retention, clock=self.clock)

    @cached_property
    def relay(self) -> BrokerRelay:
        return BrokerRelay(bus=self.bus, clock=self.clock)

    @cached_property
    def confirmations(self) -> Confirmations:
        return Confirmations(relay=self.relay)

    @cached_property
    def delivery(self) -> Delivery:
        return Delivery(bus=self.bus, mailbox=self.mailbox, relay=self.relay, tracing=self.tracing)

    @cached_property
    def command_sender(self) -> CommandSender:
        return CommandSender(
            delivery=self.delivery, keys=self.keys, metrics=self.metrics, tracing=self.tracing, clock=self.clock
        )

    @cached_property
    def xmpp_credentials(self) -> XmppCredentials:
        return XmppCredentials(
            tables=self.tables,
            keys=self.keys,
            authenticator=self.authenticator,
            sign_in=self.sign_in,
            devices=self.devices,
            clock=self.clock,
            domain=self.settings.xmpp.domain,
            browsers=bool(self.settings.xmpp.websocket_url),
        )

    @cached_property
    def polling(self) -> CommandPolling:
        return CommandPolling(tables=self.tables, mailbox=self.mailbox, clock=self.clock)

    @cached_property
    def camera_consents(self) -> CameraConsents:
        return CameraConsents(
            tables=self.tables,
            devices=self.devices,
            command_sender=self.command_sender,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def presence(self) -> PresenceIngest:
        return PresenceIngest(
            tables=self.tables,
            events=self.events,
            sessions=self.sessions_of_devices,
            audit_log=self.audit_log,
            reported_faults=self.reported_faults,
            key_announcer=KeyAnnouncer(keys=self.keys, command_sender=self.command_sender),
            camera_consents=self.camera_consents,
            clock=self.clock,
        )
