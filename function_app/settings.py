"""Settings, from the environment. The only place that reads it."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, cast
from urllib.parse import urlsplit

from device_agent.protocol.manifests.shipped import ROBOTS

ROOT = Path(__file__).resolve().parents[1]
_CONSOLE_IN_WHEEL = Path(__file__).resolve().parent / "console"
CONSOLE = _CONSOLE_IN_WHEEL if _CONSOLE_IN_WHEEL.is_dir() else ROOT / "web" / "dist"
"""Built console. A wheel contains it inside the package."""
Broker = Literal["amqtt", "mosquitto", "iot", "eventgrid"]
_LAST_PORT = 65_535
_NUMBER = re.compile(r"\A[0-9]{1,9}\Z")
_HOST = re.compile(r"\A[A-Za-z0-9._:%-]{1,255}\Z")
_PREFIX = re.compile(r"\A[A-Za-z][A-Za-z0-9]{0,31}\Z")
_CONTAINER = re.compile(r"\A(?=.{3,63}\Z)[a-z0-9]+(-[a-z0-9]+)*\Z")
_TABLE = re.compile(r"\A[A-Za-z0-9_.-]{3,255}\Z")
_BUCKET = re.compile(r"\A(?=.{3,63}\Z)[a-z0-9][a-z0-9.-]*[a-z0-9]\Z")
_REGION = re.compile(r"\A[a-z]{2,}(-[a-z]+)+-[0-9]+\Z")
_IDENTITY = re.compile(r"\A([0-9A-Fa-f]{8}(-[0-9A-Fa-f]{4}){3}-[0-9A-Fa-f]{12})?\Z")
_ENTRA_ID = re.compile(r"\A[0-9A-Fa-f]{8}(-[0-9A-Fa-f]{4}){3}-[0-9A-Fa-f]{12}\Z")
_AUDIENCE = re.compile(r"\A[!-~]{1,255}\Z")
_SECRET = re.compile(r"\A[A-Za-z0-9-]{1,127}\Z")
_KMS_KEY = re.compile(r"\A[A-Za-z0-9:/_-]{0,256}\Z")
_IOT_POLICY = re.compile(r"\A[A-Za-z0-9_+=,.@-]{0,128}\Z")
_DOMAIN = re.compile(r"\A(?=.{0,253}\Z)([a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?(\.[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)*)?\Z")
_CLIENT_ID = re.compile(r"\A[!-~]{1,255}\Z")
_PROVIDER = re.compile(r"\A[^\x00-\x1f\x7f]{1,60}\Z")
_LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})
_SHOWN = 80
"""Characters of a wrong value that are shown."""


class SettingsError(Exception):
    """A setting is wrong; the text names it and says what it may be."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AzureStore:
    """A storage account.

    Attributes:
        connection: Its connection string; or, where the functions show their managed identity instead,
        tables_url: the address of its tables,
        blobs_url: that of its blobs, and
        identity: the client id of the identity, where they have not only the one that the host gives them.
        prefix: What the names of its tables begin with.
        container: The container of its blobs.
    """

    connection: str = field(default="", repr=False)
    tables_url: str = ""
    blobs_url: str = ""
    identity: str = ""
    prefix: str = "telescope"
    container: str = "telescope"


@dataclass(frozen=True, slots=True, kw_only=True)
class AwsStore:
    """A DynamoDB table and an S3 bucket. Credentials come the SDK's own way: a role, or its own variables.

    Attributes:
        region: Where both are.
        table: The table's name.
        bucket: The bucket's name.
        endpoint: An emulator's address, ``None`` for Amazon's own.
    """

    region: str
    bucket: str
    table: str = "telescope"
    endpoint: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class IotBus:
    """AWS IoT Core, as the way to devices.

    Attributes:
        region: Where it is.
        endpoint: The account's own address for data.
        policy: The IoT policy of agents' certificates, where it is also the broker that agents and pages connect to.
    """

    region: str
    endpoint: str
    policy: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventGridWebhook:
    """Who asks about connections to an Event Grid namespace.

    Attributes:
        tenant: Id of the Entra tenant that its tokens are from.
        audience: The id URI of the application that they are for.
        caller: Object id of the namespace's managed identity.
    """

    tenant: str
    audience: str
    caller: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EventGridBus:
    """An Event Grid namespace, as the way to devices.

    Attributes:
        endpoint: The namespace's address.
        identity: The client id of the functions' identity, where they have not only the one that the host gives them.
        webhook: Who asks our webhook, where it is also the broker that agents and pages connect to.
    """

    endpoint: str
    identity: str = ""
    webhook: EventGridWebhook | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyVault:
    """A secret of Azure's Key Vault, as the place of the signing keys.

    Attributes:
        url: The vault's address.
        secret: The secret's name.
        identity: The client id of the functions' identity, where they have not only the one that the host gives them.
    """

    url: str
    secret: str = "telescope-keys"  # noqa: S105 (a name)
    identity: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SecretsManager:
    """A secret of Amazon's Secrets Manager, as the place of the signing keys.

    Attributes:
        region: Where it is.
        secret: Its name.
        kms_key: Id of the KMS key to make it with; empty for the account's own.
        endpoint: An emulator's address, ``None`` for Amazon's own.
    """

    region: str
    secret: str = "telescope-keys"  # noqa: S105 (a name)
    kms_key: str = ""
    endpoint: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Tls:
    """TLS, towards everybody and towards the broker.

    Attributes:
        certificate: The API's own, with its chain.
        key: Its key.
        ca: Who is trusted to speak for the broker; ``None``: whom the machine trusts.
        agents: Where the broker wants certificates of agents: folder of their authority, and of the functions' own.
    """

    certificate: Path
    key: Path
    ca: Path | None = None
    agents: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class OidcClient:
    """What we are to an OpenID Connect provider.

    Attributes:
        issuer: The provider's own name for itself, an address.
        client_id: Ours there.
        client_secret: Ours there; empty where it gives none to a client with PKCE.
        name: What people call it.
        anyone: Whoever it signs in gets an account here; else who was invited, alone.
    """

    issuer: str
    client_id: str
    client_secret: str = field(default="", repr=False)
    name: str
    anyone: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Where things are.

    Attributes:
        home: Folder of everything that lasts: tables, blobs, keys.
        store: Where tables and blobs are, when not in ``home``.
        keys: Where the signing keys are, when not in ``home``.
        bus: What publishes commands, when not a connection to the broker.
        host: Address to listen on.
        port: Of the page and the API.
        public_url: The page's address as people open it; sign-in links begin with it.
        tls: What the API shows, and whom the functions trust, where they speak TLS; ``None`` where they do not.
        mqtt_host: The broker's address, for the functions and for agents.
        websocket_url: The broker's address for the page.
        xmpp_domain: The part after the ``@`` of every address at the XMPP server; empty where there is none.
        xmpp_host: The XMPP server's address, for agents and for the program that speaks for the cloud.
        oidc: Where people may sign in, beside here.
        robots: Folder of the robot types.
        console: Folder of the built console.
        trusted_proxies: Proxies of one's own in front of the API; the last of ``X-Forwarded-For`` are theirs.
        rate_address: Requests a second that are answered to one address, by one process; 0: any number. So also of
        rate_account: one account,
        rate_key: one API key, and
        rate_agent: one agent.
        keep_actions_days: How long actions are kept after their end [d].
        keep_uploads_days: How long captures are kept after their upload [d].
        keep_raw_hours: How long every sample is kept, and how late one may come [h].
        keep_10s_days: How long what is left of each 10 s is kept [d]; of each minute, of each ten minutes. What is
            left of hours and days is kept for ever.
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
    xmpp_domain: str = ""
    xmpp_host: str = "127.0.0.1"
    xmpp_port: int = 5222
    oidc: OidcClient | None = None
    robots: Path = ROBOTS
    console: Path = CONSOLE
    trusted_proxies: int = 0
    rate_address: int = 200
    rate_account: int = 100
    rate_key: int = 20
    rate_agent: int = 100
    keep_actions_days: int = 30
    keep_uploads_days: int = 30
    keep_raw_hours: int = 24
    keep_10s_days: int = 7
    keep_1min_days: int = 90
    keep_10min_days: int = 730


def read(environment: Mapping[str, str] | None = None) -> Settings:
    """The settings in force.

    Raises:
        SettingsError: One is wrong.
    """
    given = os.environ if environment is None else environment
    host = _host(given, "TELESCOPE_HOST", "127.0.0.1")
    port = _port(given, "TELESCOPE_PORT", 8080)
    mqtt_host = _host(given, "TELESCOPE_MQTT_HOST", host)
    websocket_port = _port(given, "TELESCOPE_WEBSOCKET_PORT", port + 2)
    broker = given.get("TELESCOPE_BROKER", "amqtt")
    if broker not in ("amqtt", "mosquitto", "iot", "eventgrid"):
        raise SettingsError(f"TELESCOPE_BROKER is '{broker[:_SHOWN]}'; it must be amqtt, mosquitto, iot or eventgrid")
    bus = _bus(given)
    if broker == "eventgrid":
        bus = _with_webhook(given, bus)
    if broker == "iot" and not (isinstance(bus, IotBus) and bus.policy):
        raise SettingsError(
            "TELESCOPE_BROKER is iot; set TELESCOPE_BUS=iot, and TELESCOPE_IOT_POLICY to agents' certificates' policy"
        )
    tls = _tls(given)
    s = "" if tls is None else "s"
    public_url = _url(given, "TELESCOPE_PUBLIC_URL", f"http{s}://{_in_url(host)}:{port}", ("http", "https")).rstrip("/")
    websocket_url = f"ws{s}://{_in_url(mqtt_host)}:{websocket_port}/mqtt"
    return Settings(
        home=_folder(given, "TELESCOPE_HOME", Path(".telescope")),
        store=_store(given),
        keys=_keys(given),
        bus=bus,
        host=host,
        port=port,
        public_url=public_url,
        tls=tls,
        broker=cast("Broker", broker),
        mqtt_host=mqtt_host,
        mqtt_port=_port(given, "TELESCOPE_MQTT_PORT", port + 1),
        websocket_port=websocket_port,
        websocket_url=_url(given, "TELESCOPE_WEBSOCKET_URL", websocket_url, ("ws", "wss")),
        xmpp_domain=_matching(given, "TELESCOPE_XMPP_DOMAIN", "", _DOMAIN, "a domain in lower case"),
        xmpp_host=_host(given, "TELESCOPE_XMPP_HOST", host),
        xmpp_port=_port(given, "TELESCOPE_XMPP_PORT", 5222),
        oidc=_oidc(given),
        robots=_folder(given, "TELESCOPE_ROBOTS", ROBOTS),
        console=_folder(given, "TELESCOPE_CONSOLE", CONSOLE),
        trusted_proxies=_number(given, "TELESCOPE_TRUSTED_PROXIES", 0, 0, 10),
        rate_address=_number(given, "TELESCOPE_RATE_ADDRESS", 200, 0, 1_000_000),
        rate_account=_number(given, "TELESCOPE_RATE_ACCOUNT", 100, 0, 1_000_000),
        rate_key=_number(given, "TELESCOPE_RATE_KEY", 20, 0, 1_000_000),
        rate_agent=_number(given, "TELESCOPE_RATE_AGENT", 100, 0, 1_000_000),
        keep_actions_days=_number(given, "TELESCOPE_KEEP_ACTIONS_DAYS", 30, 1, 3650),
        keep_uploads_days=_number(given, "TELESCOPE_KEEP_UPLOADS_DAYS", 30, 1, 36_500),
        keep_raw_hours=_number(given, "TELESCOPE_KEEP_RAW_HOURS", 24, 1, 9600),
        keep_10s_days=_number(given, "TELESCOPE_KEEP_10S_DAYS", 7, 1, 36_500),
        keep_1min_days=_number(given, "TELESCOPE_KEEP_1MIN_DAYS", 90, 1, 36_500),
        keep_10min_days=_number(given, "TELESCOPE_KEEP_10MIN_DAYS", 730, 1, 36_500),
    )


def _keys(given: Mapping[str, str]) -> KeyVault | SecretsManager | None:
    def secret() -> str:
        what = "letters, digits and hyphens, at most 127"
        return _matching(given, "TELESCOPE_KEYS_SECRET", "telescope-keys", _SECRET, what)

    match given.get("TELESCOPE_KEYS", "local"):
        case "local":
            return None
        case "azure":
            url = _url(given, "TELESCOPE_KEYVAULT_URL", "", ("https",))
            identity = _matching(
                given, "TELESCOPE_KEYVAULT_IDENTITY", "", _IDENTITY, "the client id of a managed identity"
            )
            return KeyVault(url=url, secret=secret(), identity=identity)
        case "aws":
            kms_key = _matching(given, "TELESCOPE_KEYS_KMS_KEY", "", _KMS_KEY, "the id, alias or ARN of a KMS key")
            return SecretsManager(
                region=_region(given), secret=secret(), kms_key=kms_key, endpoint=_aws_endpoint(given)
            )
        case other:
            raise SettingsError(f"TELESCOPE_KEYS is '{other[:_SHOWN]}'; it must be local, azure or aws")


def _aws_endpoint(given: Mapping[str, str]) -> str | None:
    endpoint = given.get("TELESCOPE_AWS_ENDPOINT")
    return None if endpoint is None else _url(given, "TELESCOPE_AWS_ENDPOINT", endpoint, ("http", "https"))


def _tls(given: Mapping[str, str]) -> Tls | None:
    certificate, key = (given.get(f"TELESCOPE_TLS_{name}", "") for name in ("CERTIFICATE", "KEY"))
    if bool(certificate) != bool(key):
        raise SettingsError("TELESCOPE_TLS_CERTIFICATE and TELESCOPE_TLS_KEY belong together; set both, or neither")
    if not certificate:
        return None
    ca = _file(given, "TELESCOPE_TLS_CA") if given.get("TELESCOPE_TLS_CA") else None
    agents = _folder(given, "TELESCOPE_TLS_AGENTS", Path()) if given.get("TELESCOPE_TLS_AGENTS") else None
    return Tls(
        certificate=_file(given, "TELESCOPE_TLS_CERTIFICATE"),
        key=_file(given, "TELESCOPE_TLS_KEY"),
        ca=ca,
        agents=agents,
    )


def _file(given: Mapping[str, str], name: str) -> Path:
    path = _folder(given, name, Path())
    if not path.is_file():
        raise SettingsError(
            f"{name} is '{given[name][:_SHOWN]}'; it must be a file: make one with `python -m infra.tls`"
        )
    return path


def _store(given: Mapping[str, str]) -> AzureStore | AwsStore | None:
    match given.get("TELESCOPE_STORE", "local"):
        case "local":
            return None
        case "azure":
            return _azure(given)
        case "aws":
            return _aws(given)
        case other:
            raise SettingsError(f"TELESCOPE_STORE is '{other[:_SHOWN]}'; it must be local, azure or aws")


def _bus(given: Mapping[str, str]) -> IotBus | EventGridBus | None:
    match given.get("TELESCOPE_BUS", "mqtt"):
        case "mqtt":
            return None
        case "iot":
            return IotBus(
                region=_region(given),
                endpoint=_url(given, "TELESCOPE_IOT_ENDPOINT", "", ("https", "http")),
                policy=_matching(given, "TELESCOPE_IOT_POLICY", "", _IOT_POLICY, "the name of an IoT policy"),
            )
        case "eventgrid":
            return EventGridBus(
                endpoint=_url(given, "TELESCOPE_EVENTGRID_ENDPOINT", "", ("https",)),
                identity=_matching(
                    given, "TELESCOPE_EVENTGRID_IDENTITY", "", _IDENTITY, "the client id of a managed identity"
                ),
            )
        case other:
            raise SettingsError(f"TELESCOPE_BUS is '{other[:_SHOWN]}'; it must be mqtt, iot or eventgrid")


def _with_webhook(given: Mapping[str, str], bus: IotBus | EventGridBus | None) -> EventGridBus:
    if not isinstance(bus, EventGridBus):
        raise SettingsError("TELESCOPE_BROKER is eventgrid; set TELESCOPE_BUS=eventgrid too")
    for name in ("TELESCOPE_MQTT_HOST", "TELESCOPE_MQTT_PORT", "TELESCOPE_WEBSOCKET_URL"):
        if not given.get(name):
            raise SettingsError(f"TELESCOPE_BROKER is eventgrid; set {name} to the namespace's own")
    names = ("TELESCOPE_EVENTGRID_TENANT", "TELESCOPE_EVENTGRID_AUDIENCE", "TELESCOPE_EVENTGRID_CALLER")
    webhook = EventGridWebhook(
        tenant=_matching(given, names[0], "", _ENTRA_ID, "the id of an Entra tenant"),
        audience=_matching(given, names[1], "", _AUDIENCE, "the id URI of an application, such as api://…"),
        caller=_matching(given, names[2], "", _ENTRA_ID, "the object id of the namespace's managed identity"),
    )
    return replace(bus, webhook=webhook)


def _oidc(given: Mapping[str, str]) -> OidcClient | None:
    names = ("TELESCOPE_OIDC_ISSUER", "TELESCOPE_OIDC_CLIENT_ID")
    issuer, client_id = (given.get(name, "") for name in names)
    if not issuer and not client_id:
        if given.get("TELESCOPE_OIDC_CLIENT_SECRET"):
            raise SettingsError(f"TELESCOPE_OIDC_CLIENT_SECRET is set; set {' and '.join(names)} too, or none of them")
        return None
    if not issuer or not client_id:
        there, missing = names if issuer else names[::-1]
        raise SettingsError(f"{there} is set; set {missing} too, or neither")
    parts = urlsplit(_url(given, names[0], "", ("https", "http")))
    accounts = given.get("TELESCOPE_OIDC_ACCOUNTS", "invited")
    if accounts not in {"invited", "anyone"}:
        raise SettingsError(f"TELESCOPE_OIDC_ACCOUNTS is '{accounts[:_SHOWN]}'; it must be invited or anyone")
    if parts.scheme == "http" and parts.hostname not in _LOOPBACK:
        raise SettingsError(f"{names[0]} is '{issuer[:_SHOWN]}'; it must be an address that begins with https://")
    return OidcClient(
        issuer=issuer,
        client_id=_matching(given, names[1], "", _CLIENT_ID, "the client id that the provider gave, without spaces"),
        client_secret=given.get("TELESCOPE_OIDC_CLIENT_SECRET", ""),
        name=_matching(
            given, "TELESCOPE_OIDC_NAME", parts.hostname or "", _PROVIDER, "a name of at most 60 characters"
        ),
        anyone=accounts == "anyone",
    )


def _region(given: Mapping[str, str]) -> str:
    region = given.get("AWS_REGION", "")  # Lambda sets it
    return _matching(given, "TELESCOPE_AWS_REGION", region, _REGION, "a region, such as eu-west-1")


def _azure(given: Mapping[str, str]) -> AzureStore:
    prefix = _matching(given, "TELESCOPE_STORAGE_PREFIX", "telescope", _PREFIX, "at most 32 letters and digits")
    container = _matching(
        given, "TELESCOPE_STORAGE_CONTAINER", "telescope", _CONTAINER, "3 to 63 lower-case letters, digits and hyphens"
    )
    connection = given.get("TELESCOPE_STORAGE_CONNECTION", "")
    if connection:
        # Never shown: there is a key in it.
        if not all("=" in part for part in connection.strip("; ").split(";")):
            raise SettingsError(
                "TELESCOPE_STORAGE_CONNECTION is not a connection string; copy it from the storage account's "
                "'Access keys'"
            )
        return AzureStore(connection=connection, prefix=prefix, container=container)
    urls = ("TELESCOPE_STORAGE_TABLES_URL", "TELESCOPE_STORAGE_BLOBS_URL")
    if not all(given.get(name) for name in urls):
        raise SettingsError(
            "TELESCOPE_STORE is azure; set TELESCOPE_STORAGE_CONNECTION to the storage account's connection string, or "
            f"{' and '.join(urls)} to its addresses, to use the functions' managed identity"
        )
    tables_url, blobs_url = (_url(given, name, "", ("https",)) for name in urls)
    identity = _matching(given, "TELESCOPE_STORAGE_IDENTITY", "", _IDENTITY, "the client id of a managed identity")
    return AzureStore(tables_url=tables_url, blobs_url=blobs_url, identity=identity, prefix=prefix, container=container)


def _aws(given: Mapping[str, str]) -> AwsStore:
    return AwsStore(
        region=_region(given),
        bucket=_matching(given, "TELESCOPE_AWS_BUCKET", "", _BUCKET, "the name of an S3 bucket"),
        table=_matching(given, "TELESCOPE_AWS_TABLE", "telescope", _TABLE, "the name of a DynamoDB table"),
        endpoint=_aws_endpoint(given),
    )


def _matching(given: Mapping[str, str], name: str, otherwise: str, pattern: re.Pattern[str], what: str) -> str:
    text = given.get(name, otherwise)
    if not pattern.match(text):
        shown = " ".join(text[:_SHOWN].split())  # on one line, whatever it is
        raise SettingsError(f"{name} is '{shown}'; it must be {what}")
    return text


def _host(given: Mapping[str, str], name: str, otherwise: str) -> str:
    """An address or name. Never empty: that would mean every address of the machine."""
    text = given.get(name, otherwise)
    if not _HOST.match(text):
        raise SettingsError(f"{name} is '{text[:_SHOWN]}'; it must be an address or name, such as 127.0.0.1")
    return text


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _folder(given: Mapping[str, str], name: str, otherwise: Path) -> Path:
    text = given.get(name, str(otherwise))
    try:
        if text:
            return Path(text).expanduser().resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise SettingsError(f"{name} is '{text[:_SHOWN]}'; it must be a folder ({error})") from error
    raise SettingsError(f"{name} is empty; it must be a folder")


def _port(given: Mapping[str, str], name: str, otherwise: int) -> int:
    return _number(given, name, otherwise, 1, _LAST_PORT)


def _number(given: Mapping[str, str], name: str, otherwise: int, least: int, most: int) -> int:
    text = given.get(name, str(otherwise))
    if not _NUMBER.match(text) or not least <= int(text) <= most:
        raise SettingsError(f"{name} is '{text[:_SHOWN]}'; it must be a number from {least} to {most}")
    return int(text)


def _url(given: Mapping[str, str], name: str, otherwise: str, schemes: tuple[str, ...]) -> str:
    text = given.get(name, otherwise)
    try:
        parts = urlsplit(text)
        good = parts.scheme in schemes and bool(parts.hostname) and (parts.port is None or parts.port > 0)
    except ValueError:
        good = False
    if not good or any(letter.isspace() or letter in ";,'\"" for letter in text):
        begin = " or ".join(f"{each}://" for each in schemes)
        raise SettingsError(f"{name} is '{text[:_SHOWN]}'; it must be an address that begins with {begin}")
    return text
