"""Creates the adapters that the settings select: signing keys, stores, broker access, command bus and feeds.

Only the selected store and cloud adapters are imported. They import their SDKs at the first call.
"""

import hashlib
import logging
import shutil
import ssl
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from function_app.adapters.local.blobs import FileBlobs
from function_app.adapters.local.clock import SystemClock
from function_app.adapters.local.password_hasher import Argon2Hashes
from function_app.adapters.local.robot_catalogue import FolderCatalogue
from function_app.adapters.shared.key_ring_keys import RingKeys
from function_app.adapters.shared.vault_keys import VaultKeys
from function_app.ports.blobs import Blobs, Transfers, origin_of
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.certificates import Certificates
from function_app.ports.clock import Clock
from function_app.ports.command_bus import CommandBus
from function_app.ports.feeds import DeviceFeed, TelemetryFeed
from function_app.ports.monitoring import Metrics, NoMetrics, NoTracing, Tracing
from function_app.ports.oidc_provider import OidcProvider
from function_app.ports.password_hasher import PasswordHasher
from function_app.ports.robot_catalogue import RobotCatalogue
from function_app.ports.tables import StoreError, Tables
from function_app.settings import AwsStore, AzureStore, EventGridBus, IotBus, KeyVault, SecretsManager, Settings

if TYPE_CHECKING:
    from function_app.adapters.mqtt.connection import Broker

BLOBS_PATH = "/api/v1/blobs"
"""Path of presigned URLs of ``FileBlobs``."""
MOSQUITTO_SERVICE = "service"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Adapters:
    """The implementation of each port that the services use."""

    keys: RingKeys
    tables: Tables
    blobs: Blobs
    transfers: Transfers | None
    access: BrokerAccess
    bus: CommandBus
    feed: DeviceFeed
    telemetry: TelemetryFeed
    late: TelemetryFeed
    certificates: Certificates
    password_hashes: PasswordHasher
    catalogue: RobotCatalogue
    free_bytes: Callable[[], int | None] = lambda: None
    stored_bytes: Callable[[], dict[str, int]] = dict
    metrics: Metrics = field(default_factory=NoMetrics)
    tracing: Tracing = field(default_factory=NoTracing)


def adapters(settings: Settings, clock: Clock) -> Adapters:
    """The adapters that the settings choose. Opens no connection.

    Raises:
        StoreError: The signing keys cannot be used.
    """
    signing = keys(settings, clock.now_ms)
    tables, blobs = stores(settings, signing)

    async def publish(topic: str, payload: bytes) -> None:
        await command_bus.publish(topic, payload)

    broker_access = access(settings, signing, tables, publish)
    command_bus = bus(settings, broker_access)
    feed, telemetry, late = feeds(settings, broker_access)
    return Adapters(
        keys=signing,
        tables=tables,
        blobs=blobs,
        transfers=blobs if isinstance(blobs, FileBlobs) else None,
        access=broker_access,
        bus=command_bus,
        feed=feed,
        telemetry=telemetry,
        late=late,
        certificates=certificates(settings),
        password_hashes=Argon2Hashes(),
        catalogue=FolderCatalogue(settings.robots),
        free_bytes=lambda: _least(free_bytes(settings), tables.left_bytes()),
        stored_bytes=_stored_bytes(settings),
        metrics=metrics(),
        tracing=tracing(settings),
    )


def _stored_bytes(settings: Settings) -> Callable[[], dict[str, int]]:
    if settings.store is not None:
        return dict
    from function_app.adapters.local.monitoring.storage_use import StorageUse  # noqa: PLC0415
    from function_app.adapters.local.table_file import FILE_NAME  # noqa: PLC0415

    return StorageUse(settings.home / FILE_NAME, settings.home / "blobs").read


def metrics() -> Metrics:
    """The metrics of this process; none where the package is not installed, as on cloud hosts."""
    try:
        from function_app.adapters.local.monitoring.prometheus import PrometheusMetrics  # noqa: PLC0415 (optional)
    except ModuleNotFoundError:
        return NoMetrics()
    return PrometheusMetrics()


def tracing(settings: Settings) -> Tracing:
    """The traces of this process; none without a receiver or without the packages, as on cloud hosts."""
    if not settings.tracing:
        return NoTracing()
    try:
        from function_app.adapters.local.monitoring.otlp_tracing import OtlpTracing  # noqa: PLC0415 (optional)
    except ModuleNotFoundError as error:
        _log.warning("no traces: install telescope-server[tracing]; the Python package %s is missing", error.name)
        return NoTracing()
    return OtlpTracing()


def _least(*sizes: int | None) -> int | None:
    return min((size for size in sizes if size is not None), default=None)


def free_bytes(settings: Settings) -> int | None:
    """Free disk space of the store on this machine [bytes]; ``None`` for a cloud store."""
    if settings.store is not None:
        return None
    home = settings.home
    return shutil.disk_usage(next(folder for folder in (home, *home.parents) if folder.is_dir())).free


def keys(settings: Settings, now_ms: Callable[[], int]) -> RingKeys:
    """The signing keys. Reads key files; makes no request to a vault.

    Raises:
        StoreError: They cannot be used.
    """
    match settings.keys:
        case KeyVault() as vault:
            from function_app.adapters.azure.client import Endpoint  # noqa: PLC0415 (only where it is in use)
            from function_app.adapters.azure.signing_keys import KeyVaultKeys  # noqa: PLC0415

            endpoint = Endpoint(url=vault.url, identity=vault.identity)
            return KeyVaultKeys(secret=vault.secret, endpoint=endpoint, now_ms=now_ms)
        case SecretsManager() as manager:
            from function_app.adapters.aws.signing_keys import SecretsManagerKeys  # noqa: PLC0415

            return SecretsManagerKeys(
                secret=manager.secret,
                region=manager.region,
                endpoint=manager.endpoint,
                kms_key=manager.kms_key,
                now_ms=now_ms,
            )
        case None:
            from function_app.adapters.local.signing_keys import FileKeys  # noqa: PLC0415

            file_keys = FileKeys(settings.home / "keys", now_ms=now_ms)
            file_keys.load()
            return file_keys


def oidc_provider(settings: Settings, clock: Clock) -> OidcProvider | None:
    """The configured OpenID Connect provider, or ``None``."""
    if settings.oidc is None:
        return None
    from function_app.adapters.oidc.provider import HttpOidcProvider  # noqa: PLC0415 (only where it is in use)

    oidc = settings.oidc
    return HttpOidcProvider(issuer=oidc.issuer, client_id=oidc.client_id, client_secret=oidc.client_secret, clock=clock)


def stores(settings: Settings, signing: RingKeys | None = None) -> tuple[Tables, Blobs]:
    """Tables and blobs."""
    match settings.store:
        case AzureStore() as azure:
            from function_app.adapters.azure.blobs import AzureBlobs  # noqa: PLC0415
            from function_app.adapters.azure.client import Endpoint  # noqa: PLC0415
            from function_app.adapters.azure.tables import AzureTables  # noqa: PLC0415

            tables = Endpoint(azure.connection, azure.tables_url, azure.identity)
            blobs = Endpoint(azure.connection, azure.blobs_url, azure.identity)
            return (
                AzureTables(endpoint=tables, prefix=azure.prefix),
                AzureBlobs(endpoint=blobs, container=azure.container),
            )
        case AwsStore() as aws:
            from function_app.adapters.aws.blobs import S3Blobs  # noqa: PLC0415
            from function_app.adapters.aws.tables import DynamoTables  # noqa: PLC0415

            return (
                DynamoTables(table=aws.table, region=aws.region, endpoint=aws.endpoint),
                S3Blobs(bucket=aws.bucket, region=aws.region, endpoint=aws.endpoint),
            )
        case None:
            from function_app.adapters.local.table_file import FILE_NAME  # noqa: PLC0415
            from function_app.adapters.local.tables import SqliteTables  # noqa: PLC0415

            max_bytes = settings.storage_limits.max_tables_mb * 1_000_000
            return SqliteTables(settings.home / FILE_NAME, max_bytes=max_bytes), _files(settings, signing)


def access(
    settings: Settings, signing: RingKeys, tables: Tables, publish: Callable[[str, bytes], Awaitable[None]]
) -> BrokerAccess:
    """Issues and revokes broker credentials. ``publish`` sends revocations to the embedded broker."""
    if settings.broker == "iot":
        from function_app.adapters.aws.broker_access import IotBrokerAccess  # noqa: PLC0415 (only where it is in use)

        iot = settings.bus
        assert isinstance(iot, IotBus)  # noqa: S101 (validated by the settings)
        return IotBrokerAccess(keys=signing, tables=tables, region=iot.region, endpoint=iot.endpoint)
    if settings.broker == "eventgrid":
        return _event_grid(settings, signing, tables)
    from function_app.adapters.local.broker_access import MosquittoBrokerAccess, TokenBrokerAccess  # noqa: PLC0415

    if settings.broker == "amqtt":
        return TokenBrokerAccess(signer=signing.signer, publish=publish)
    return MosquittoBrokerAccess(
        host=settings.mqtt_host,
        port=settings.mqtt_port,
        username=MOSQUITTO_SERVICE,
        password_file=settings.home / "mosquitto" / "service.password",
        tls=broker_tls(settings),
    )


def _event_grid(settings: Settings, signing: RingKeys, tables: Tables) -> BrokerAccess:
    from function_app.adapters.azure.broker_access import EventGridBrokerAccess  # noqa: PLC0415 (only where in use)
    from function_app.adapters.azure.session_takeover import SessionTakeover  # noqa: PLC0415
    from function_app.adapters.azure.webhook_auth import EntraTokenVerifier  # noqa: PLC0415
    from function_app.adapters.mqtt.tls import client_context  # noqa: PLC0415

    grid = settings.bus
    assert isinstance(grid, EventGridBus)  # noqa: S101 (validated by the settings)
    assert grid.webhook is not None  # noqa: S101
    webhook = grid.webhook
    verifier = EntraTokenVerifier(tenant=webhook.tenant, audience=webhook.audience, identity=webhook.caller)
    # Its certificate has a public CA, independent of the CA of this installation.
    takeover = SessionTakeover(host=settings.mqtt_host, port=settings.mqtt_port, tls=client_context(None))
    return EventGridBrokerAccess(keys=signing, tables=tables, take_over=takeover, verify_caller=verifier.verify)


def bus(settings: Settings, broker_access: BrokerAccess) -> CommandBus:
    """The command bus."""
    match settings.bus:
        case IotBus() as iot:
            from function_app.adapters.aws.command_bus import IotCommandBus  # noqa: PLC0415 (only where it is in use)

            return IotCommandBus(region=iot.region, endpoint=iot.endpoint)
        case EventGridBus() as grid:
            from function_app.adapters.azure.command_bus import EventGridCommandBus  # noqa: PLC0415

            return EventGridCommandBus(endpoint=grid.endpoint, identity=grid.identity)
        case None:
            from function_app.adapters.local.command_bus import MqttCommandBus  # noqa: PLC0415

            return MqttCommandBus(_broker(settings, broker_access))


def feeds(settings: Settings, broker_access: BrokerAccess) -> tuple[DeviceFeed, TelemetryFeed, TelemetryFeed]:
    """The feeds of device messages, of telemetry, and of telemetry that was recorded during a disconnection."""
    from function_app.adapters.local.device_feed import MqttDeviceFeed, MqttTelemetryFeed  # noqa: PLC0415

    broker = _broker(settings, broker_access)
    return MqttDeviceFeed(broker), MqttTelemetryFeed(broker), MqttTelemetryFeed(broker, late=True)


def certificates(settings: Settings) -> Certificates:
    """The certificate authority for agents."""
    if settings.broker == "iot":
        from function_app.adapters.aws.certificates import IotCertificates  # noqa: PLC0415 (only where it is in use)

        iot = settings.bus
        assert isinstance(iot, IotBus)  # noqa: S101 (validated by the settings)
        return IotCertificates(region=iot.region, policy=iot.policy)
    from function_app.adapters.local.certificates import FileCertificates, NoCertificates  # noqa: PLC0415

    if settings.tls is None or settings.tls.agents is None:
        return NoCertificates()
    return FileCertificates(settings.tls.agents)


def broker_tls(settings: Settings) -> ssl.SSLContext | None:
    """The TLS context of connections to the broker; ``None`` for connections without TLS.

    Raises:
        BrokerAccessError: The certificate of the authority cannot be read.
    """
    from function_app.adapters.mqtt.tls import client_context  # noqa: PLC0415

    return None if settings.tls is None else client_context(settings.tls.ca, settings.tls.agents)


async def prepare(settings: Settings) -> None:
    """Create the cloud resources that must exist before the first use. Idempotent.

    This covers AWS stores, IoT policies and vault secrets. Files and Azure stores are created at the first write.

    Raises:
        StoreError: A resource cannot be created.
    """
    if settings.broker == "iot":
        from function_app.adapters.aws.certificates import IotCertificates  # noqa: PLC0415

        agents = certificates(settings)
        assert isinstance(agents, IotCertificates)  # noqa: S101 (validated by the settings)
        try:
            await agents.prepare()
        except BrokerAccessError as error:
            raise StoreError(str(error)) from error
        finally:
            await agents.close()
    if settings.keys is not None:
        vault = keys(settings, SystemClock().now_ms)
        assert isinstance(vault, VaultKeys)  # noqa: S101 (validated by the settings)
        try:
            await vault.prepare()
        finally:
            await vault.close()
    if isinstance(settings.store, AwsStore):
        from function_app.adapters.aws.blobs import S3Blobs  # noqa: PLC0415
        from function_app.adapters.aws.tables import DynamoTables  # noqa: PLC0415

        for store in stores(settings):
            try:
                if isinstance(store, S3Blobs):
                    await store.prepare(console=origin_of(settings.public_url))
                else:
                    assert isinstance(store, DynamoTables)  # noqa: S101 (validated by the settings)
                    await store.prepare()
            finally:
                await store.close()


def _broker(settings: Settings, broker_access: BrokerAccess) -> "Broker":
    """The broker, with the credentials of the functions."""
    from function_app.adapters.mqtt.connection import Broker  # noqa: PLC0415

    return Broker(
        host=settings.mqtt_host,
        port=settings.mqtt_port,
        credentials=broker_access.service_credentials,
        tls=broker_tls(settings),
    )


def _files(settings: Settings, signing: RingKeys | None) -> FileBlobs:
    """Blobs in files. Instances with the same signing keys accept each other's presigned URLs."""

    def derived() -> list[bytes]:
        secrets = () if signing is None else signing.secrets()
        return [hashlib.sha256(b"telescope/v1/blobs" + secret).digest() for secret in secrets]

    url = f"{settings.public_url}{BLOBS_PATH}"

    def is_full() -> bool:
        free = free_bytes(settings)
        return free is not None and free < settings.storage_limits.min_free_mb * 1_000_000

    return FileBlobs(settings.home / "blobs", keys=None if signing is None else derived, url=url, is_full=is_full)
