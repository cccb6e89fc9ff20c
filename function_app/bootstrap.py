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
from function_app.ports.command_feed import Orders
from function_app.ports.device_feed import Feed, Telemetry
from function_app.ports.signing_keys import Keys
from function_app.ports.tables import Tables
from function_app.ports.xmpp_connection import XmppConnection
from function_app.services.accounts.api_keys import ApiKeys
from function_app.services.accounts.oidc_sign_in import OpenIdSignIn
from function_app.services.accounts.passwords import Passwords
from function_app.services.accounts.sign_out import SignOut
from function_app.services.actions.acks import ActionAcks
from function_app.services.actions.action_store import ActionRows
from function_app.services.actions.dispatcher import SendAction
from function_app.services.actions.query import Actions
from function_app.services.actions.queue import Queues
from function_app.services.actions.start import StartAction
from function_app.services.actions.start_many import StartOnMany
from function_app.services.actions.stop import StopDevices
from function_app.services.audit.audit_log import AuditLog
from function_app.services.audit.audit_reader import AuditReader
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.control_requests import Handovers
from function_app.services.control.fencing import ControlRevocation
from function_app.services.control.lease_store import LeaseRows
from function_app.services.control.leases import Leases
from function_app.services.control.mqtt_credentials import MqttCredentials
from function_app.services.devices.device_access import Devices
from function_app.services.devices.rename import Rename
from function_app.services.devices.spaces import Spaces
from function_app.services.devices.viewers import Viewers
from function_app.services.health.diagnostics import Diagnostics
from function_app.services.health.faults import Faults
from function_app.services.health.reported_faults import ReportedFaults
from function_app.services.identity.authenticator import Identify
from function_app.services.identity.guess_limiter import Attempts
from function_app.services.identity.rate_limiter import Limits
from function_app.services.identity.sessions import Sessions
from function_app.services.identity.sign_in import SignIn
from function_app.services.maintenance.readiness import CheckHealth
from function_app.services.maintenance.scheduler import Scheduler
from function_app.services.messaging.broker_relay import BrokerRelay
from function_app.services.messaging.command_sender import Commands
from function_app.services.messaging.delivery import Delivery
from function_app.services.messaging.key_announcer import KeyAnnouncer
from function_app.services.messaging.mailbox import Mailbox
from function_app.services.messaging.polling import Polling
from function_app.services.messaging.presence import PresenceIngest
from function_app.services.messaging.xmpp_credentials import XmppAccess
from function_app.services.pairing.agent_certificates import AgentCertificates
from function_app.services.pairing.claim import Claim
from function_app.services.pairing.enroll import Enroll
from function_app.services.pairing.offboarding import Offboarding
from function_app.services.pairing.unpair import Unpair
from function_app.services.robot_types.catalogue import RobotTypes
from function_app.services.robot_types.cleanup import RobotTypeCleanup
from function_app.services.robot_types.delete import DeleteRobotType
from function_app.services.robot_types.integrity import IntegritySeals
from function_app.services.robot_types.model_validation import ModelChecks
from function_app.services.robot_types.movements import Movements
from function_app.services.robot_types.preview import RobotTypePreview
from function_app.services.robot_types.upload import UploadRobotType
from function_app.services.robot_types.versions import TypeVersions
from function_app.services.sharing.access_revocation import AccessRevocation
from function_app.services.sharing.invitations import Invitations
from function_app.services.sharing.ownership_transfer import Transfer
from function_app.services.sharing.shares import Sharing
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import DAY_MS, Retention
from function_app.services.telemetry.event_log import Events
from function_app.services.telemetry.ingest import TelemetryIngest
from function_app.services.telemetry.latency import Latencies
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
    feed: Feed
    telemetry: Telemetry
    late: Telemetry
    access: BrokerAccess
    certificates: Certificates
    certify: AgentCertificates
    keys: Keys
    clock: Clock
    identify: Identify
    sign_in: SignIn
    sessions: Sessions
    sign_out: SignOut
    passwords: Passwords
    open_id: OpenIdSignIn
    api_keys: ApiKeys
    enroll: Enroll
    claim: Claim
    unpair: Unpair
    rename: Rename
    watchers: Viewers
    devices: Devices
    spaces: Spaces
    sharing: Sharing
    invitations: Invitations
    leases: Leases
    handovers: Handovers
    robot_types: RobotTypes
    upload_robot_type: UploadRobotType
    look_at_robot_type: RobotTypePreview
    delete_robot_type: DeleteRobotType
    model_checks: ModelChecks
    movements: Movements
    start_action: StartAction
    fleet: StartOnMany
    actions: Actions
    queues: Queues
    action_acks: ActionAcks
    stop: StopDevices
    mqtt_credentials: MqttCredentials
    xmpp_access: XmppAccess
    presence: PresenceIngest
    polling: Polling
    mailbox: Mailbox
    relay: BrokerRelay
    forget: Retention
    events: Events
    faults: Faults
    conditions: ReportedFaults
    diagnostics: Diagnostics
    latencies: Latencies
    intake: TelemetryIngest
    uploads: Uploads
    transfers: Transfers | None
    series: SeriesReader
    chain: AuditLog
    trail: AuditReader
    limits: Limits
    sweep: Scheduler
    health: CheckHealth

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

    forget = Retention(tables=tables, blobs=blobs)
    pending = Reminders(tables=tables)
    chain = AuditLog(tables=tables, blobs=blobs, keys=keys, forget=forget, pending=pending, clock=now)
    events = Events(tables=tables, forget=forget, clock=now)
    faults = Faults(tables=tables, events=events, forget=forget, clock=now)
    conditions = ReportedFaults(tables=tables, faults=faults, clock=now)
    identify = Identify(tables=tables, keys=keys, forget=forget, clock=now)
    sessions = Sessions(tables=tables, identify=identify, forget=forget, chain=chain, clock=now)
    sign_in = SignIn(tables=tables, sessions=sessions, chain=chain, clock=now)
    attempts = Attempts(tables=tables, forget=forget, clock=now)
    devices = Devices(tables=tables, clock=now)
    spaces = Spaces(tables=tables, clock=now)
    keep = _keep(settings)
    writer = SeriesWriter(tables=tables, forget=forget, keep=keep, clock=now)
    uploads = Uploads(tables=tables, blobs=blobs, keep_ms=settings.keep_uploads_days * DAY_MS, clock=now)
    mailbox = Mailbox(tables=tables, forget=forget, clock=now)
    relay = BrokerRelay(bus=bus, clock=now)
    delivery = Delivery(bus=bus, mailbox=mailbox, relay=relay)
    commands = Commands(delivery=delivery, keys=keys, clock=now)
    robot_types = RobotTypes(tables=tables, blobs=blobs, catalogue=catalogue, seals=IntegritySeals(keys=keys))
    versions = TypeVersions(tables=tables, blobs=blobs, clock=now)
    upload_robot_type = UploadRobotType(
        tables=tables,
        versions=versions,
        catalogue=catalogue,
        robot_types=robot_types,
        seals=IntegritySeals(keys=keys),
        chain=chain,
        clock=now,
    )
    diagnostics = Diagnostics(
        tables=tables, devices=devices, faults=faults, robot_types=robot_types, spaces=spaces, clock=now
    )
    intake = TelemetryIngest(tables=tables, writer=writer, clock=now, observers=(diagnostics.observe,))
    movements = Movements(
        tables=tables,
        blobs=blobs,
        catalogue=catalogue,
        robot_types=robot_types,
        keys=keys,
        forget=forget,
        chain=chain,
        clock=now,
    )
    rows = ActionRows(tables=tables)
    audit = ControlEvents(tables=tables, events=events, chain=chain, pending=pending, clock=now)
    lease_rows = LeaseRows(tables=tables, audit=audit, clock=now)
    fence = ControlRevocation(tables=tables, commands=commands, access=access, clock=now)
    leases = Leases(
        tables=tables,
        devices=devices,
        rows=lease_rows,
        fence=fence,
        commands=commands,
        access=access,
        audit=audit,
        clock=now,
    )
    sign_out = SignOut(
        tables=tables,
        identify=identify,
        sessions=sessions,
        access=access,
        devices=devices,
        leases=leases,
        chain=chain,
        clock=now,
    )
    api_keys = ApiKeys(
        tables=tables,
        devices=devices,
        sign_in=sign_in,
        sign_out=sign_out,
        chain=chain,
        forget=forget,
        pending=pending,
        clock=now,
    )
    sending = SendAction(tables=tables, devices=devices, rows=rows, commands=commands, movements=movements, clock=now)
    queues = Queues(tables=tables, devices=devices, rows=rows, pending=pending, sending=sending, audit=audit, clock=now)
    leave = Offboarding(
        tables=tables,
        rows=rows,
        queues=queues,
        pending=pending,
        fence=fence,
        access=access,
        certificates=chosen.certificates,
        bus=bus,
        series=writer,
        forget=forget,
        audit=audit,
        clock=now,
    )
    sharing = Sharing(
        tables=tables,
        devices=devices,
        spaces=spaces,
        sign_in=sign_in,
        unshare=AccessRevocation(
            tables=tables,
            devices=devices,
            rows=rows,
            queues=queues,
            commands=commands,
            fence=fence,
            access=access,
            clock=now,
        ),
        pending=pending,
        audit=audit,
        chain=chain,
        clock=now,
    )
    invitations = Invitations(
        tables=tables,
        sharing=sharing,
        transfer=Transfer(tables=tables, devices=devices, sharing=sharing, leave=leave, clock=now),
        sign_in=sign_in,
        pending=pending,
        forget=forget,
        chain=chain,
        clock=now,
    )
    latencies = Latencies(tables=tables, forget=forget, clock=now)
    acks = ActionAcks(rows=rows, queues=queues, mailbox=mailbox, latencies=latencies, clock=now)
    start_action = StartAction(
        tables=tables,
        devices=devices,
        movements=movements,
        commands=commands,
        rows=rows,
        acks=acks,
        pending=pending,
        queues=queues,
        delivery=delivery,
        audit=audit,
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
        certify=AgentCertificates(certificates=chosen.certificates),
        keys=keys,
        clock=now,
        identify=identify,
        sign_in=sign_in,
        sessions=sessions,
        sign_out=sign_out,
        api_keys=api_keys,
        open_id=OpenIdSignIn(
            tables=tables,
            provider=factory.open_id(settings, now),
            redirect=f"{settings.public_url}{OPEN_ID_PATH}",
            anyone=settings.open_id is not None and settings.open_id.anyone,
            sign_in=sign_in,
            sessions=sessions,
            invitations=invitations,
            chain=chain,
            clock=now,
        ),
        passwords=Passwords(
            tables=tables,
            hashes=chosen.password_hashes,
            attempts=attempts,
            sign_in=sign_in,
            sessions=sessions,
            sign_out=sign_out,
            chain=chain,
            clock=now,
        ),
        enroll=Enroll(tables=tables, leave=leave, forget=forget, clock=now),
        claim=Claim(tables=tables, sign_in=sign_in, attempts=attempts, leave=leave, chain=chain, clock=now),
        unpair=Unpair(tables=tables, sign_in=sign_in, leave=leave, chain=chain),
        rename=Rename(tables=tables, devices=devices, chain=chain),
        watchers=Viewers(tables=tables, devices=devices, forget=forget, clock=now),
        devices=devices,
        spaces=spaces,
        sharing=sharing,
        invitations=invitations,
        leases=leases,
        handovers=Handovers(
            tables=tables,
            devices=devices,
            leases=leases,
            rows=lease_rows,
            commands=commands,
            audit=audit,
            clock=now,
        ),
        robot_types=robot_types,
        upload_robot_type=upload_robot_type,
        look_at_robot_type=RobotTypePreview(
            tables=tables,
            blobs=blobs,
            versions=versions,
            catalogue=catalogue,
            robot_types=robot_types,
            upload=upload_robot_type,
            seals=IntegritySeals(keys=keys),
            clock=now,
        ),
        delete_robot_type=DeleteRobotType(
            tables=tables, catalogue=catalogue, devices=devices, movements=movements, chain=chain, clock=now
        ),
        model_checks=ModelChecks(tables=tables, blobs=blobs, compiler=MujocoCompiler(), clock=now),
        movements=movements,
        start_action=start_action,
        fleet=StartOnMany(start_action=start_action),
        actions=Actions(
            tables=tables, devices=devices, rows=rows, acks=acks, commands=commands, delivery=delivery, clock=now
        ),
        queues=queues,
        action_acks=acks,
        stop=StopDevices(
            devices=devices,
            spaces=spaces,
            rows=lease_rows,
            commands=commands,
            queues=queues,
            delivery=delivery,
            audit=audit,
        ),
        mqtt_credentials=MqttCredentials(tables=tables, devices=devices, access=access, audit=audit, clock=now),
        xmpp_access=XmppAccess(
            tables=tables,
            keys=keys,
            identify=identify,
            sign_in=sign_in,
            devices=devices,
            clock=now,
            domain=settings.xmpp_domain,
        ),
        polling=Polling(tables=tables, mailbox=mailbox, clock=now),
        mailbox=mailbox,
        relay=relay,
        presence=PresenceIngest(
            tables=tables,
            events=events,
            conditions=conditions,
            keys=KeyAnnouncer(keys=keys, commands=commands),
            clock=now,
        ),
        forget=forget,
        events=events,
        faults=faults,
        conditions=conditions,
        diagnostics=diagnostics,
        latencies=latencies,
        intake=intake,
        uploads=uploads,
        transfers=chosen.transfers,
        series=SeriesReader(tables=tables, devices=devices, keep=keep, clock=now),
        chain=chain,
        trail=AuditReader(tables=tables, blobs=blobs, keys=keys),
        limits=Limits(
            per_s={
                "address": settings.rate_address,
                "account": settings.rate_account,
                "key": settings.rate_key,
                "agent": settings.rate_agent,
            },
            clock=now,
        ),
        sweep=Scheduler(
            tables=tables,
            rows=rows,
            pending=pending,
            commands=commands,
            sending=sending,
            queues=queues,
            leave=leave,
            sharing=sharing,
            invitations=invitations,
            api_keys=api_keys,
            audit=audit,
            chain=chain,
            access=access,
            forget=forget,
            conditions=conditions,
            intake=intake,
            uploads=uploads,
            robot_types=RobotTypeCleanup(tables=tables, blobs=blobs, clock=now),
            keep_actions_ms=settings.keep_actions_days * DAY_MS,
            clock=now,
        ),
        health=CheckHealth(tables=tables, bus=bus),
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
        return (await functions.xmpp_access.cloud()).password

    return SlixmppLine(host=settings.xmpp_host, port=settings.xmpp_port, domain=settings.xmpp_domain, password=password)


def orders(functions: Functions) -> Orders:
    """What the broker brings for agents that a program of ours speaks for, not yet open."""
    settings = functions.settings
    return MqttOrders(
        host=settings.mqtt_host, port=settings.mqtt_port, access=functions.access, tls=factory.broker_tls(settings)
    )
