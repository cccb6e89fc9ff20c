"""TLS, sign-in with OpenID Connect, and limits of requests and connections."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from function_app.domain.identity.accounts import fold_name
from function_app.settings.environment import Environment, SettingsError

_CLIENT_ID = re.compile(r"\A[!-~]{1,255}\Z")
_PROVIDER = re.compile(r"\A[^\x00-\x1f\x7f]{1,60}\Z")
_HOST_NAMES = re.compile(r"\A[A-Za-z0-9._:\[\], -]{0,2000}\Z")
_TOKEN = re.compile(r"\A([!-~]{16,255})?\Z")
_LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Tls:
    """Certificates of the API and of broker connections.

    Attributes:
        certificate: Certificate chain of the API.
        key: Private key of the API.
        ca: CA certificate of the broker; ``None``: the CAs that the machine trusts.
        agents: Folder of the agent CA and of the server's client certificate, if the broker requires certificates.
    """

    certificate: Path
    key: Path
    ca: Path | None = None
    agents: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class OidcClient:
    """Registration of this server at an OpenID Connect provider.

    Attributes:
        issuer: The provider's issuer URL.
        client_id: Client id at the provider.
        client_secret: Client secret; empty for a public client with PKCE.
        name: Name on the sign-in page.
        anyone: Create an account for every user of the provider; otherwise only for invited users.
    """

    issuer: str
    client_id: str
    client_secret: str = field(default="", repr=False)
    name: str
    anyone: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class RateLimits:
    """Requests per second that one process accepts from one client of each kind; 0: no limit."""

    address: int = 200
    account: int = 100
    key: int = 20
    agent: int = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Administration:
    """Access to the state of the installation.

    Attributes:
        accounts: Folded names of the accounts that may read it.
        metrics_token: Bearer token of a monitoring system; empty: only loopback addresses may read the metrics.
    """

    accounts: frozenset[str] = frozenset()
    metrics_token: str = field(default="", repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionSettings:
    """Connections and host names that ``serve`` accepts.

    Attributes:
        total: Open connections of the process; fewer if the limit of open files is lower.
        per_address: Open connections of one address; 0: no limit.
        hosts: Further names in the ``Host`` header.
    """

    total: int = 4_000
    per_address: int = 256
    hosts: tuple[str, ...] = ()


def read_connections(env: Environment) -> ConnectionSettings:
    """The limits of connections, and the accepted host names."""
    default = ConnectionSettings()
    names = env.matching(
        "TELESCOPE_ALLOWED_HOSTS", "", _HOST_NAMES, "host names without ports, separated by commas, such as a.example,b"
    )
    return ConnectionSettings(
        total=env.number("TELESCOPE_CONNECTIONS", default.total, 64, 60_000),
        per_address=env.number("TELESCOPE_CONNECTIONS_PER_ADDRESS", default.per_address, 0, 60_000),
        hosts=tuple(name.strip().strip("[]").lower() for name in names.split(",") if name.strip()),
    )


def read_rate_limits(env: Environment) -> RateLimits:
    """The request limits."""
    default = RateLimits()
    return RateLimits(
        address=env.number("TELESCOPE_RATE_ADDRESS", default.address, 0, 1_000_000),
        account=env.number("TELESCOPE_RATE_ACCOUNT", default.account, 0, 1_000_000),
        key=env.number("TELESCOPE_RATE_KEY", default.key, 0, 1_000_000),
        agent=env.number("TELESCOPE_RATE_AGENT", default.agent, 0, 1_000_000),
    )


def read_tls(env: Environment) -> Tls | None:
    """The certificates; ``None`` without TLS."""
    certificate, key = (env.get(f"TELESCOPE_TLS_{name}", "") for name in ("CERTIFICATE", "KEY"))
    if bool(certificate) != bool(key):
        raise SettingsError("TELESCOPE_TLS_CERTIFICATE and TELESCOPE_TLS_KEY belong together; set both, or neither")
    if not certificate:
        return None
    ca = env.file("TELESCOPE_TLS_CA") if env.get("TELESCOPE_TLS_CA") else None
    agents = env.folder("TELESCOPE_TLS_AGENTS", Path()) if env.get("TELESCOPE_TLS_AGENTS") else None
    return Tls(
        certificate=env.file("TELESCOPE_TLS_CERTIFICATE"), key=env.file("TELESCOPE_TLS_KEY"), ca=ca, agents=agents
    )


def read_oidc(env: Environment) -> OidcClient | None:
    """The OpenID Connect client; ``None`` without a provider."""
    names = ("TELESCOPE_OIDC_ISSUER", "TELESCOPE_OIDC_CLIENT_ID")
    issuer, client_id = (env.get(name, "") for name in names)
    if not issuer and not client_id:
        if env.get("TELESCOPE_OIDC_CLIENT_SECRET"):
            raise SettingsError(f"TELESCOPE_OIDC_CLIENT_SECRET is set; set {' and '.join(names)} too, or none of them")
        return None
    if not issuer or not client_id:
        present, missing = names if issuer else names[::-1]
        raise SettingsError(f"{present} is set; set {missing} too, or neither")
    parts = urlsplit(env.url(names[0], "", ("https", "http")))
    accounts = env.get("TELESCOPE_OIDC_ACCOUNTS", "invited")
    if accounts not in {"invited", "anyone"}:
        raise env.invalid("TELESCOPE_OIDC_ACCOUNTS", "invited or anyone")
    if parts.scheme == "http" and parts.hostname not in _LOOPBACK:
        raise env.invalid(names[0], "an address that begins with https://")
    return OidcClient(
        issuer=issuer,
        client_id=env.matching(names[1], "", _CLIENT_ID, "the client id that the provider gave, without spaces"),
        client_secret=env.get("TELESCOPE_OIDC_CLIENT_SECRET", ""),
        name=env.matching("TELESCOPE_OIDC_NAME", parts.hostname or "", _PROVIDER, "a name of at most 60 characters"),
        anyone=accounts == "anyone",
    )


def read_administration(env: Environment) -> Administration:
    """Administrators, and the token of the metrics."""
    name = "TELESCOPE_METRICS_TOKEN"
    if not _TOKEN.match(env.get(name)):  # the message must not contain it
        raise SettingsError(f"{name} is invalid; it must be 16 to 255 characters without spaces")
    accounts = (fold_name(account) for account in env.get("TELESCOPE_ADMINISTRATORS").split(","))
    return Administration(accounts=frozenset(filter(None, accounts)), metrics_token=env.get(name))


def read_tracing(env: Environment) -> bool:
    """Whether a standard variable names a receiver of traces."""
    return any(env.get(f"OTEL_EXPORTER_OTLP_{name}") for name in ("ENDPOINT", "TRACES_ENDPOINT"))
