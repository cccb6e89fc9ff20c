"""Authenticates access tokens of people and programs, and signed requests of agents."""

import math
import secrets
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Final, Literal

import jwt
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import signing
from device_agent.protocol.topics import ANY
from function_app.domain.common.ids import agent_id, new_id
from function_app.domain.common.problems import unauthorized
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.identity.session_status import signed_out_key
from function_app.services.storage import records
from function_app.services.storage.retention import Retention

ALGORITHM = "EdDSA"
API: Final = "telescope/api"
SESSION: Final = "telescope/session"
XMPP: Final = "telescope/xmpp"
DEVICE: Final = "telescope/device"
"""A browser or program that has signed in before. Its token grants nothing but its own limit of wrong passwords."""
ACCESS_S = 15 * 60
"""Lifetime of an access token [s]. The session cookie gets the next one."""
SESSION_S = 12 * 3600
DEVICE_S: Final = 180 * 86_400
"""Validity of the token of a known browser after its last sign-in [s]."""
AGENT_TOKEN_S = 60
CLOCK_SKEW_S = 30
"""Tolerated clock difference of an agent [s]."""
MAX_CACHED_TOKENS = 4096
RECHECK_MS = 5_000
"""Interval at which a cached token is checked for sign-out again [ms]."""

Audience = Literal["telescope/api", "telescope/session", "telescope/xmpp", "telescope/device"]


@dataclass(slots=True)
class _CachedToken:
    identity: Identity
    expires_ms: int
    checked_ms: int
    csrf: str


class Authenticator:
    """Issues and verifies tokens. Verified tokens are cached, because a signature costs 0.1 ms."""

    def __init__(self, *, tables: Tables, keys: SigningKeys, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._keys = keys
        self._clock = clock
        self._cache: OrderedDict[tuple[str, str], _CachedToken] = OrderedDict()

    async def issue(self, caller: Identity, audience: Audience, lifetime_s: int, *, csrf: str | None = None) -> str:
        """Issue a token for a sign-in session, which it does not outlive. ``csrf`` belongs to a cookie."""
        key = await self._keys.current()
        now_ms = self._clock.now_ms()
        claims = {
            "iss": "telescope",
            "aud": audience,
            "sub": caller.account,
            "name": caller.name,
            "sid": caller.session,
            "iat": now_ms // 1000,
            "exp": now_ms // 1000 + caller.lifetime_s(lifetime_s, now_ms),
            "until": caller.until_ms // 1000,
            "jti": new_id(),
        }
        if csrf is not None:
            claims["csrf"] = csrf
        return jwt.encode(claims, key, ALGORITHM, headers={"kid": signing.key_id(key.public_key())})

    async def person(self, token: str, audience: Audience) -> Identity:
        """The identity behind an access token. Raises ``unauthorized``: forged, expired, or signed out."""
        return (await self._find(token, audience)).identity

    async def page(self, cookie: str) -> tuple[Identity, str]:
        """The identity behind a page's cookie, and its CSRF token. Raises ``unauthorized``."""
        cached = await self._find(cookie, SESSION)
        return cached.identity, cached.csrf

    async def _find(self, token: str, audience: Audience) -> _CachedToken:
        now_ms = self._clock.now_ms()
        cached = self._cache.get((audience, token))
        if cached is None or not self._is_current(cached, now_ms):
            # Verify completely, not only the sign-out: the signing key may have leaked.
            cached = await self._verify(token, audience)
            self._cache_token((audience, token), cached)
        if now_ms >= cached.expires_ms:
            self._cache.pop((audience, token), None)
            raise unauthorized("The access token has expired. Sign in again.")
        return cached

    def _cache_token(self, name: tuple[str, str], cached: _CachedToken) -> None:
        """Cache a verified token, unless it expires before the next check."""
        self._cache[name] = cached
        self._cache.move_to_end(name)
        while len(self._cache) > MAX_CACHED_TOKENS or not self._is_current(
            next(iter(self._cache.values())), cached.checked_ms
        ):
            self._cache.popitem(last=False)

    @staticmethod
    def _is_current(cached: _CachedToken, now_ms: int) -> bool:
        return 0 <= now_ms - cached.checked_ms < RECHECK_MS

    async def sign_out(self, caller: Identity) -> None:
        """End the session: other instances reject its tokens within ``RECHECK_MS``."""
        ends_ms = self._clock.now_ms() + SESSION_S * 1000
        row = Row(caller.account, signed_out_key(caller.session), {"expires_ms": ends_ms})
        await self._retention.delete_row_at(records.ACCOUNTS, row.partition, row.key, due_ms=ends_ms)
        try:
            await self._tables.create(records.ACCOUNTS, row)
        except Conflict:
            return
        finally:
            for name in [name for name, cached in self._cache.items() if cached.identity.session == caller.session]:
                del self._cache[name]

    async def enrolling(self, token: str, public_key: str) -> str:
        """The id of the agent with this ``public_key``, which must have signed ``token``. Raises ``unauthorized``."""
        try:
            key = signing.public_key(public_key)
        except ProtocolError as error:
            raise unauthorized(f"public_key: {error}.") from error
        self._check_agent(token, key)
        return agent_id(signing.key_id(key))

    async def agent(self, token: str) -> Agent:
        """The enrolled agent that signed ``token``. Raises ``unauthorized``."""
        try:
            kid = str(jwt.get_unverified_header(token).get("kid", ""))
            agent = agent_id(kid)
        except (jwt.PyJWTError, ValueError) as error:
            raise unauthorized("The agent's token names no key (header kid).") from error
        row = await self._tables.get(records.AGENTS, agent, "agent")
        if row is None:
            raise unauthorized("This agent is not enrolled. Enroll it first.")
        record = records.read(row, Agent)
        self._check_agent(token, signing.public_key(record.public_key))
        return record

    async def _verify(self, token: str, audience: Audience) -> _CachedToken:
        try:
            kid = jwt.get_unverified_header(token).get("kid", "")
            key = (await self._keys.public(str(kid))).get(str(kid))
            if key is None:
                raise unauthorized("The access token was not issued here. Sign in again.")
            claims = decode(token, key, audience, now_s=self._now_s(), leeway_s=0)
            identity = Identity(
                account=str(claims["sub"]),
                name=str(claims["name"]),
                session=str(claims["sid"]),
                # A token without session end limits grants to its own lifetime.
                until_ms=int(claims.get("until", claims["exp"])) * 1000,
            )
        except jwt.ExpiredSignatureError as error:
            raise unauthorized("The access token has expired. Sign in again.") from error
        except (jwt.PyJWTError, KeyError) as error:
            raise unauthorized("The access token is not valid. Sign in again.") from error
        await self._check_signed_out(identity)
        return _CachedToken(identity, int(claims["exp"]) * 1000, self._clock.now_ms(), str(claims.get("csrf", "")))

    async def _check_signed_out(self, caller: Identity) -> None:
        if await self._tables.get(records.ACCOUNTS, caller.account, signed_out_key(caller.session)) is not None:
            raise unauthorized("This session was signed out. Sign in again.")

    def _check_agent(self, token: str, key: Ed25519PublicKey) -> None:
        try:
            claims = decode(token, key, API, now_s=self._now_s(), leeway_s=CLOCK_SKEW_S)
        except jwt.PyJWTError as error:
            raise unauthorized(f"The agent's token is not valid: {error}.") from error
        if claims.get("iss") != "agent" or claims["exp"] - claims["iat"] > AGENT_TOKEN_S:
            raise unauthorized(f"An agent's token needs iss 'agent' and a lifetime of at most {AGENT_TOKEN_S} s.")

    def _now_s(self) -> float:
        return self._clock.now_ms() / 1000


def new_session() -> str:
    """The id of a new sign-in session."""
    return new_id()


def principal(caller: Identity) -> str:
    """Broker principal of a sign-in session; signing out revokes exactly this principal."""
    return f"account:{caller.account}:{caller.session}"


def viewer_principal(caller: Identity) -> str:
    """Part of the principal for viewing, which can be revoked separately and by account (``all_viewers``)."""
    return f"{principal(caller)}:watch"


def all_viewers(account: str) -> str:
    """Pattern of all viewing connections of an account, for ``BrokerAccess.revoke``."""
    return f"account:{account}:{ANY}:watch"


def everything(account: str) -> str:
    """Pattern of all connections of an account, for ``BrokerAccess.revoke``."""
    return f"account:{account}"


def new_secret() -> str:
    """A random secret of 256 bits."""
    return secrets.token_urlsafe(32)


def decode(token: str, key: Ed25519PublicKey, audience: str, *, now_s: float, leeway_s: float) -> dict[str, Any]:
    """The claims of a signed token. Times are checked against our own clock.

    Raises:
        jwt.PyJWTError: Forged, for another purpose, not valid yet, or expired.
    """
    claims: dict[str, Any] = jwt.decode(
        token,
        key,
        algorithms=[ALGORITHM],
        audience=audience,
        options={
            "require": ["exp", "iat", "aud", "jti"],
            "verify_exp": False,
            "verify_iat": False,
            "verify_nbf": False,
        },
    )
    times = (claims["iat"], claims["exp"])
    if not all(isinstance(moment, int | float) and math.isfinite(moment) for moment in times):
        raise jwt.DecodeError("exp and iat must be seconds since 1970")
    if claims["iat"] > now_s + leeway_s:
        raise jwt.ImmatureSignatureError("the token was issued in the future; set this machine's clock")
    if claims["exp"] <= now_s - leeway_s:
        raise jwt.ExpiredSignatureError("the token has expired")
    return claims
