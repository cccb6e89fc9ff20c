"""Puts the functions together: the adapters, of which settings make ``choices``, and the services on top of them.

As long as there are services: each is made here once, with all that it is given, and nothing is decided.
"""

from dataclasses import dataclass

from function_app.adapters import factory
from function_app.adapters.factory import Adapters
from function_app.adapters.local.clock import SystemClock
from function_app.adapters.local.command_feed import MqttOrders
from function_app.adapters.model_compiler.compiler import MujocoCompiler
from function_app.domain.telemetry.series import RetentionPolicy
from function_app.ports.blobs import Blobs, Transfers
from function_app.ports.broker_access import BrokerAccess
from function_app.ports.certificates import Certificates
from function_app.ports.clock import Clock
from function_app.ports.command_bus import CommandBus
from function_app.ports.command_feed import CommandFeed
from function_app.ports.device_feed import DeviceFeed, TelemetryFeed
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Tables
from function_app.ports.xmpp_connection import XmppConnection
from function_app.services.accounts.api_keys import ApiKeys
from function_app.services.accounts.oidc_sign_in import OidcSignIn
from function_app.services.accounts.passwords import Passwords
from function_app.services.accounts.sign_out import SignOut
from function_app.services.actions.acks import ActionAcks
from function_app.services.actions.action_store import ActionStore
from function_app.services.actions.dispatcher import ActionDispatcher
from function_app.services.actions.query import Actions
from function_app.services.actions.queue import ActionQueues
from function_app.services.actions.start import StartAction
from function_app.services.actions.start_many import StartOnMany
from function_app.services.actions.stop import StopDevices
from function_app.services.audit.audit_log import AuditLog
from function_app.services.audit.audit_reader import AuditReader
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.control_requests import ControlRequests
from function_app.services.control.fencing import ControlRevocation
from function_app.services.control.lease_store import LeaseStore
from function_app.services.control.leases import Leases
from function_app.services.control.mqtt_credentials import MqttCredentials
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.devices.rename import DeviceRename
from function_app.services.devices.spaces import Spaces
from function_app.services.devices.viewers import Viewers
from function_app.services.health.diagnostics import Diagnostics
from function_app.services.health.faults import Faults
from function_app.services.health.reported_faults import ReportedFaults
from function_app.services.identity.authenticator import Authenticator
from function_app.services.identity.guess_limiter import GuessLimiter
from function_app.services.identity.rate_limiter import RateLimiter
from function_app.services.identity.sessions import Sessions
from function_app.services.identity.sign_in import SignIn
from function_app.services.maintenance.readiness import ReadinessCheck
from function_app.services.maintenance.scheduler import Scheduler
from function_app.services.messaging.broker_relay import BrokerRelay
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Delivery
from function_app.services.messaging.key_announcer import KeyAnnouncer
from function_app.services.messaging.mailbox import Mailbox
from function_app.services.messaging.polling import CommandPolling
from function_app.services.messaging.presence import PresenceIngest
from function_app.services.messaging.xmpp_credentials import XmppCredentials
from function_app.services.pairing.agent_certificates import AgentCertificates
from function_app.services.pairing.claim import Claim
from function_app.services.pairing.enroll import Enroll
from function_app.services.pairing.offboarding import Offboarding
from function_app.services.pairing.unpair import Unpair
from function_app.services.robot_types.catalogue import RobotTypes
from function_app.services.robot_types.cleanup import RobotTypeCleanup
from function_app.services.robot_types.delete import RobotTypeDeletion
from function_app.services.robot_types.integrity import IntegritySeals
from function_app.services.robot_types.model_validation import ModelValidator
from function_app.services.robot_types.movements import Movements
from function_app.services.robot_types.preview import RobotTypePreview
from function_app.services.robot_types.upload import RobotTypeUpload
from function_app.services.robot_types.versions import TypeVersions
from function_app.services.sharing.access_revocation import AccessRevocation
from function_app.services.sharing.invitations import Invitations
from function_app.services.sharing.ownership_transfer import OwnershipTransfer
from function_app.services.sharing.shares import Sharing
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import DAY_MS, Retention
from function_app.services.telemetry.event_log import EventLog
from function_app.services.telemetry.ingest import TelemetryIngest
from function_app.services.telemetry.latency import LatencyStore
from function_app.services.telemetry.series_reader import SeriesReader
from function_app.services.telemetry.series_writer import SeriesWriter
from function_app.services.telemetry.uploads import Uploads
from function_app.settings import Settings, SettingsError

OPEN_ID_PATH = "/api/v1/auth/oidc/callback"
"""Where a provider sends browsers back to; it has to be told this address."""


@dataclass(frozen=True, slots=True)
class Functions:
    """Everything the entry points use."""

    settings: Settings
    tables: Tables
    blobs: Blobs
    bus: CommandBus
    feed: DeviceFeed
    telemetry: TelemetryFeed
    late: TelemetryFeed
    access: BrokerAccess
    certificates: Certificates
    agent_certificates: AgentCertificates
    keys: SigningKeys
    clock: Clock
    authenticator: Authenticator
    sign_in: SignIn
    sessions: Sessions
    sign_out: SignOut
    passwords: Passwords
    open_id: OidcSignIn
    api_keys: ApiKeys
    enroll: Enroll
    claim: Claim
    unpair: Unpair
    rename: DeviceRename
    viewers: Viewers
    devices: DeviceAccess
    spaces: Spaces
    sharing: Sharing
    invitations: Invitations
    leases: Leases
    control_requests: ControlRequests
    robot_types: RobotTypes
    upload_robot_type: RobotTypeUpload
    robot_type_preview: RobotTypePreview
    delete_robot_type: RobotTypeDeletion
    model_checks: ModelValidator
    movements: Movements
    start_action: StartAction
    start_many: StartOnMany
    actions: Actions
    queues: ActionQueues
    action_acks: ActionAcks
    stop: StopDevices
    mqtt_credentials: MqttCredentials
    xmpp_credentials: XmppCredentials
    presence: PresenceIngest
    polling: CommandPolling
    mailbox: Mailbox
    relay: BrokerRelay
    retention: Retention
    events: EventLog
    faults: Faults
    reported_faults: ReportedFaults
    diagnostics: Diagnostics
    latencies: LatencyStore
    telemetry_ingest: TelemetryIngest
    uploads: Uploads
    transfers: Transfers | None
    series: SeriesReader
    audit_log: AuditLog
    audit_reader: AuditReader
    rate_limiter: RateLimiter
    scheduler: Scheduler
    health: ReadinessCheck

    async def close(self) -> None:
        """Let go of all connections."""
        await self.bus.close()
        await self.access.close()
        await self.tables.close()
        await self.blobs.close()
        await self.keys.close()
        await self.certificates.close()


def build(settings: Settings, *, clock: Clock | None = None, adapters: Adapters | None = None) -> Functions:
    """The services over the adapters that the settings choose. Reads the signing keys, opens no connection.

    Args:
        settings: Of this installation.
        clock: The wall clock; by default the machine's.
        adapters: Used instead of those that the settings choose.

    Raises:
        StoreError: The signing keys cannot be used.
    """
    now = clock or SystemClock()
    chosen = adapters or factory.adapters(settings, now)
    keys, tables, blobs, catalogue = chosen.keys, chosen.tables, chosen.blobs, chosen.catalogue
    access, bus = chosen.access, chosen.bus

    retention = Retention(tables=tables, blobs=blobs)
    reminders = Reminders(tables=tables)
    audit_log = AuditLog(tables=tables, blobs=blobs, keys=keys, retention=retention, reminders=reminders, clock=now)
    events = EventLog(tables=tables, retention=retention, clock=now)
    faults = Faults(tables=tables, events=events, retention=retention, clock=now)
    reported_faults = ReportedFaults(tables=tables, faults=faults, clock=now)
    authenticator = Authenticator(tables=tables, keys=keys, retention=retention, clock=now)
    sessions = Sessions(tables=tables, authenticator=authenticator, retention=retention, audit_log=audit_log, clock=now)
    sign_in = SignIn(tables=tables, sessions=sessions, audit_log=audit_log, clock=now)
    guess_limiter = GuessLimiter(tables=tables, retention=retention, clock=now)
    devices = DeviceAccess(tables=tables, clock=now)
    spaces = Spaces(tables=tables, clock=now)
    keep = _keep(settings)
    writer = SeriesWriter(tables=tables, retention=retention, keep=keep, clock=now)
    uploads = Uploads(tables=tables, blobs=blobs, keep_ms=settings.keep_uploads_days * DAY_MS, clock=now)
    mailbox = Mailbox(tables=tables, retention=retention, clock=now)
    relay = BrokerRelay(bus=bus, clock=now)
    delivery = Delivery(bus=bus, mailbox=mailbox, relay=relay)
    command_sender = CommandSender(delivery=delivery, keys=keys, clock=now)
    robot_types = RobotTypes(tables=tables, blobs=blobs, catalogue=catalogue, integrity=IntegritySeals(keys=keys))
    versions = TypeVersions(tables=tables, blobs=blobs, clock=now)
    upload_robot_type = RobotTypeUpload(
        tables=tables,
        versions=versions,
        catalogue=catalogue,
        robot_types=robot_types,
        integrity=IntegritySeals(keys=keys),
        audit_log=audit_log,
        clock=now,
    )
    diagnostics = Diagnostics(
        tables=tables, devices=devices, faults=faults, robot_types=robot_types, spaces=spaces, clock=now
    )
    telemetry_ingest = TelemetryIngest(tables=tables, writer=writer, clock=now, observers=(diagnostics.observe,))
    movements = Movements(
        tables=tables,
        blobs=blobs,
        catalogue=catalogue,
        robot_types=robot_types,
        keys=keys,
        retention=retention,
        audit_log=audit_log,
        clock=now,
    )
    action_store = ActionStore(tables=tables)
    control_events = ControlEvents(tables=tables, events=events, audit_log=audit_log, reminders=reminders, clock=now)
    lease_store = LeaseStore(tables=tables, control_events=control_events, clock=now)
    revocation = ControlRevocation(tables=tables, command_sender=command_sender, access=access, clock=now)
    leases = Leases(
        tables=tables,
        devices=devices,
        lease_store=lease_store,
        revocation=revocation,
        command_sender=command_sender,
        access=access,
        control_events=control_events,
        clock=now,
    )
    sign_out = SignOut(
        tables=tables,
        authenticator=authenticator,
        sessions=sessions,
        access=access,
        devices=devices,
        leases=leases,
        audit_log=audit_log,
        clock=now,
    )
    api_keys = ApiKeys(
        tables=tables,
        devices=devices,
        sign_in=sign_in,
        sign_out=sign_out,
        audit_log=audit_log,
        retention=retention,
        reminders=reminders,
        clock=now,
    )
    dispatcher = ActionDispatcher(
        tables=tables,
        devices=devices,
        action_store=action_store,
        command_sender=command_sender,
        movements=movements,
        clock=now,
    )
    queues = ActionQueues(
        tables=tables,
        devices=devices,
        action_store=action_store,
        reminders=reminders,
        dispatcher=dispatcher,
        control_events=control_events,
        clock=now,
    )
    offboarding = Offboarding(
        tables=tables,
        action_store=action_store,
        queues=queues,
        reminders=reminders,
        revocation=revocation,
        access=access,
        certificates=chosen.certificates,
        bus=bus,
        series=writer,
        retention=retention,
        control_events=control_events,
        clock=now,
    )
    sharing = Sharing(
        tables=tables,
        devices=devices,
        spaces=spaces,
        sign_in=sign_in,
        access_revocation=AccessRevocation(
            tables=tables,
            devices=devices,
            action_store=action_store,
            queues=queues,
            command_sender=command_sender,
            revocation=revocation,
            access=access,
            clock=now,
        ),
        reminders=reminders,
        control_events=control_events,
        audit_log=audit_log,
        clock=now,
    )
    invitations = Invitations(
        tables=tables,
        sharing=sharing,
        ownership_transfer=OwnershipTransfer(
            tables=tables, devices=devices, sharing=sharing, offboarding=offboarding, clock=now
        ),
        sign_in=sign_in,
        reminders=reminders,
        retention=retention,
        audit_log=audit_log,
        clock=now,
    )
    latencies = LatencyStore(tables=tables, retention=retention, clock=now)
    acks = ActionAcks(action_store=action_store, queues=queues, mailbox=mailbox, latencies=latencies, clock=now)
    start_action = StartAction(
        tables=tables,
        devices=devices,
        movements=movements,
        command_sender=command_sender,
        action_store=action_store,
        acks=acks,
        reminders=reminders,
        queues=queues,
        delivery=delivery,
        control_events=control_events,
        clock=now,
    )
    return Functions(
        settings=settings,
        tables=tables,
        blobs=blobs,
        bus=bus,
        feed=chosen.feed,
        telemetry=chosen.telemetry,
        late=chosen.late,
        access=access,
        certificates=chosen.certificates,
        agent_certificates=AgentCertificates(certificates=chosen.certificates),
        keys=keys,
        clock=now,
        authenticator=authenticator,
        sign_in=sign_in,
        sessions=sessions,
        sign_out=sign_out,
        api_keys=api_keys,
        open_id=OidcSignIn(
            tables=tables,
            provider=factory.open_id(settings, now),
            redirect=f"{settings.public_url}{OPEN_ID_PATH}",
            anyone=settings.open_id is not None and settings.open_id.anyone,
            sign_in=sign_in,
            sessions=sessions,
            invitations=invitations,
            audit_log=audit_log,
            clock=now,
        ),
        passwords=Passwords(
            tables=tables,
            hasher=chosen.password_hashes,
            guess_limiter=guess_limiter,
            sign_in=sign_in,
            sessions=sessions,
            sign_out=sign_out,
            audit_log=audit_log,
            clock=now,
        ),
        enroll=Enroll(tables=tables, offboarding=offboarding, retention=retention, clock=now),
        claim=Claim(
            tables=tables,
            sign_in=sign_in,
            guess_limiter=guess_limiter,
            offboarding=offboarding,
            audit_log=audit_log,
            clock=now,
        ),
        unpair=Unpair(tables=tables, sign_in=sign_in, offboarding=offboarding, audit_log=audit_log),
        rename=DeviceRename(tables=tables, devices=devices, audit_log=audit_log),
        viewers=Viewers(tables=tables, devices=devices, retention=retention, clock=now),
        devices=devices,
        spaces=spaces,
        sharing=sharing,
        invitations=invitations,
        leases=leases,
        control_requests=ControlRequests(
            tables=tables,
            devices=devices,
            leases=leases,
            lease_store=lease_store,
            command_sender=command_sender,
            control_events=control_events,
            clock=now,
        ),
        robot_types=robot_types,
        upload_robot_type=upload_robot_type,
        robot_type_preview=RobotTypePreview(
            tables=tables,
            blobs=blobs,
            versions=versions,
            catalogue=catalogue,
            robot_types=robot_types,
            upload=upload_robot_type,
            integrity=IntegritySeals(keys=keys),
            clock=now,
        ),
        delete_robot_type=RobotTypeDeletion(
            tables=tables, catalogue=catalogue, devices=devices, movements=movements, audit_log=audit_log, clock=now
        ),
        model_checks=ModelValidator(tables=tables, blobs=blobs, compiler=MujocoCompiler(), clock=now),
        movements=movements,
        start_action=start_action,
        start_many=StartOnMany(start_action=start_action),
        actions=Actions(
            tables=tables,
            devices=devices,
            action_store=action_store,
            acks=acks,
            command_sender=command_sender,
            delivery=delivery,
            clock=now,
        ),
        queues=queues,
        action_acks=acks,
        stop=StopDevices(
            devices=devices,
            spaces=spaces,
            lease_store=lease_store,
            command_sender=command_sender,
            queues=queues,
            delivery=delivery,
            control_events=control_events,
        ),
        mqtt_credentials=MqttCredentials(
            tables=tables, devices=devices, access=access, control_events=control_events, clock=now
        ),
        xmpp_credentials=XmppCredentials(
            tables=tables,
            keys=keys,
            authenticator=authenticator,
            sign_in=sign_in,
            devices=devices,
            clock=now,
            domain=settings.xmpp_domain,
        ),
        polling=CommandPolling(tables=tables, mailbox=mailbox, clock=now),
        mailbox=mailbox,
        relay=relay,
        presence=PresenceIngest(
            tables=tables,
            events=events,
            reported_faults=reported_faults,
            key_announcer=KeyAnnouncer(keys=keys, command_sender=command_sender),
            clock=now,
        ),
        retention=retention,
        events=events,
        faults=faults,
        reported_faults=reported_faults,
        diagnostics=diagnostics,
        latencies=latencies,
        telemetry_ingest=telemetry_ingest,
        uploads=uploads,
        transfers=chosen.transfers,
        series=SeriesReader(tables=tables, devices=devices, keep=keep, clock=now),
        audit_log=audit_log,
        audit_reader=AuditReader(tables=tables, blobs=blobs, keys=keys),
        rate_limiter=RateLimiter(
            per_s={
                "address": settings.rate_address,
                "account": settings.rate_account,
                "key": settings.rate_key,
                "agent": settings.rate_agent,
            },
            clock=now,
        ),
        scheduler=Scheduler(
            tables=tables,
            action_store=action_store,
            reminders=reminders,
            command_sender=command_sender,
            dispatcher=dispatcher,
            queues=queues,
            offboarding=offboarding,
            sharing=sharing,
            invitations=invitations,
            api_keys=api_keys,
            control_events=control_events,
            audit_log=audit_log,
            access=access,
            retention=retention,
            reported_faults=reported_faults,
            telemetry_ingest=telemetry_ingest,
            uploads=uploads,
            robot_types=RobotTypeCleanup(tables=tables, blobs=blobs, clock=now),
            keep_actions_ms=settings.keep_actions_days * DAY_MS,
            clock=now,
        ),
        health=ReadinessCheck(tables=tables, bus=bus),
    )


def _keep(settings: Settings) -> RetentionPolicy:
    return RetentionPolicy(
        raw_ms=settings.keep_raw_hours * DAY_MS // 24,
        levels_ms={
            "10s": settings.keep_10s_days * DAY_MS,
            "1min": settings.keep_1min_days * DAY_MS,
            "10min": settings.keep_10min_days * DAY_MS,
        },
    )


def xmpp_line(functions: Functions) -> XmppConnection:
    """The cloud's own connection to the XMPP server, not yet open.

    Raises:
        SettingsError: The settings name no XMPP server.
    """
    from function_app.adapters.xmpp.connection import SlixmppLine  # noqa: PLC0415 (only where it is in use)

    settings = functions.settings
    if not settings.xmpp_domain:
        raise SettingsError("TELESCOPE_XMPP_DOMAIN is empty; it must be the domain that the XMPP server serves")

    async def password() -> str:
        return (await functions.xmpp_credentials.cloud()).password

    return SlixmppLine(host=settings.xmpp_host, port=settings.xmpp_port, domain=settings.xmpp_domain, password=password)


def orders(functions: Functions) -> CommandFeed:
    """What the broker brings for agents that a program of ours speaks for, not yet open."""
    settings = functions.settings
    return MqttOrders(
        host=settings.mqtt_host, port=settings.mqtt_port, access=functions.access, tls=factory.broker_tls(settings)
    )
