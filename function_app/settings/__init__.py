"""Settings of the server. The only package that reads the environment."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from device_agent.protocol.manifests.shipped import ROBOTS
from function_app.settings.access import (
    Administration,
    ConnectionSettings,
    OidcClient,
    RateLimits,
    Tls,
    read_administration,
    read_connections,
    read_oidc,
    read_rate_limits,
    read_tls,
    read_tracing,
)
from function_app.settings.broker import Broker, EventGridBus, EventGridWebhook, IotBus, Xmpp, read_broker, read_xmpp
from function_app.settings.environment import Environment, SettingsError
from function_app.settings.storage import (
    AwsStore,
    AzureStore,
    KeyVault,
    RetentionPeriods,
    SecretsManager,
    StorageLimits,
    read_keys,
    read_retention,
    read_storage_limits,
    read_store,
)

__all__ = [
    "CONSOLE",
    "ROOT",
    "Administration",
    "AwsStore",
    "AzureStore",
    "ConnectionSettings",
    "EventGridBus",
    "EventGridWebhook",
    "IotBus",
    "KeyVault",
    "OidcClient",
    "RateLimits",
    "RetentionPeriods",
    "SecretsManager",
    "Settings",
    "SettingsError",
    "StorageLimits",
    "Tls",
    "Xmpp",
    "read",
]

_PACKAGE = Path(__file__).resolve().parents[1]
ROOT = _PACKAGE.parent
_CONSOLE_IN_WHEEL = _PACKAGE / "console"
CONSOLE = _CONSOLE_IN_WHEEL if _CONSOLE_IN_WHEEL.is_dir() else ROOT / "web" / "dist"
"""Built console. A wheel contains it inside the package."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings of one installation.

    Attributes:
        home: Folder of the persistent data: tables, blobs, keys.
        store: Cloud store of tables and blobs; ``None``: ``home``.
        keys: Vault of the signing keys; ``None``: ``home``.
        bus: Publisher of commands; ``None``: a connection to the broker.
        host: Address to listen on.
        port: Port of the console and the API.
        public_url: URL of the console in a browser. Sign-in links begin with it.
        tls: Certificates, where the server uses TLS.
        mqtt_host: Address of the broker, for the functions and for agents.
        websocket_url: Address of the broker, for browsers.
        oidc: OpenID Connect provider.
        robots: Folder of the robot types.
        console: Folder of the built console.
        tracing: Whether traces are exported. The exporter reads its standard variables (``OTEL_…``) itself.
        trusted_proxies: Number of own proxies in front of the API. They append the last addresses of
            ``X-Forwarded-For``.
        allow_unconfined_models: Check uploaded models even where their parser cannot be confined.
    """

    home: Path
    store: AzureStore | AwsStore | None = None
    keys: KeyVault | SecretsManager | None = None
    bus: IotBus | EventGridBus | None = None
    host: str = "127.0.0.1"
    port: int = 8080
    public_url: str = "http://127.0.0.1:8080"
    tls: Tls | None = None
    broker: Broker = "amqtt"
    mqtt_host: str = "127.0.0.1"
    mqtt_port: int = 8081
    websocket_port: int = 8082
    websocket_url: str = "ws://127.0.0.1:8082/mqtt"
    xmpp: Xmpp = field(default_factory=Xmpp)
    oidc: OidcClient | None = None
    robots: Path = ROBOTS
    console: Path = CONSOLE
    tracing: bool = False
    trusted_proxies: int = 0
    administration: Administration = field(default_factory=Administration)
    connections: ConnectionSettings = field(default_factory=ConnectionSettings)
    allow_unconfined_models: bool = False
    rate_limits: RateLimits = field(default_factory=RateLimits)
    retention: RetentionPeriods = field(default_factory=RetentionPeriods)
    storage_limits: StorageLimits = field(default_factory=StorageLimits)


def read(environment: Mapping[str, str] | None = None) -> Settings:
    """The settings in the environment.

    Raises:
        SettingsError: A variable is invalid.
    """
    env = Environment(os.environ if environment is None else environment)
    host = env.host("TELESCOPE_HOST", "127.0.0.1")
    port = env.port("TELESCOPE_PORT", 8080)
    mqtt_host = env.host("TELESCOPE_MQTT_HOST", host)
    websocket_port = env.port("TELESCOPE_WEBSOCKET_PORT", port + 2)
    broker, bus = read_broker(env)
    tls = read_tls(env)
    s = "" if tls is None else "s"
    websocket_url = f"ws{s}://{_in_url(mqtt_host)}:{websocket_port}/mqtt"
    public_url = env.url("TELESCOPE_PUBLIC_URL", f"http{s}://{_in_url(host)}:{port}", ("http", "https"))
    return Settings(
        home=env.folder("TELESCOPE_HOME", Path(".telescope")),
        store=read_store(env),
        keys=read_keys(env),
        bus=bus,
        host=host,
        port=port,
        public_url=public_url.rstrip("/"),
        tls=tls,
        broker=broker,
        mqtt_host=mqtt_host,
        mqtt_port=env.port("TELESCOPE_MQTT_PORT", port + 1),
        websocket_port=websocket_port,
        websocket_url=env.url("TELESCOPE_WEBSOCKET_URL", websocket_url, ("ws", "wss")),
        xmpp=read_xmpp(env, host),
        oidc=read_oidc(env),
        robots=env.folder("TELESCOPE_ROBOTS", ROBOTS),
        console=env.folder("TELESCOPE_CONSOLE", CONSOLE),
        tracing=read_tracing(env),
        trusted_proxies=env.number("TELESCOPE_TRUSTED_PROXIES", 0, 0, 10),
        administration=read_administration(env),
        connections=read_connections(env),
        allow_unconfined_models=env.number("TELESCOPE_ALLOW_UNCONFINED_MODELS", 0, 0, 1) == 1,
        rate_limits=read_rate_limits(env),
        retention=read_retention(env),
        storage_limits=read_storage_limits(env),
    )


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host
