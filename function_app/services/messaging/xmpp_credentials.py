"""XMPP passwords, and the contacts of each user.

A password is a signed token for this purpose only. The server verifies it at each login; nothing is stored. A user is
an agent, an account or the cloud. Agents and accounts are contacts while they are paired.
"""

from dataclasses import dataclass
from typing import Final, Literal

import jwt

from device_agent.protocol.security import signing
from device_agent.protocol.topics import is_id
from device_agent.protocol.xmpp import jids
from function_app.domain.common.ids import AGENT_LENGTH, new_id
from function_app.domain.common.problems import Problem, unauthorized
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Tables
from function_app.services.devices.device_access import DeviceAccess, require_claimed
from function_app.services.identity.authenticator import (
    ACCESS_S,
    ALGORITHM,
    API,
    SESSION_S,
    XMPP,
    Authenticator,
    decode,
)
from function_app.services.identity.sign_in import SignIn
from function_app.services.storage import records

AGENT_S: Final = 3600
LOGIN_S: Final = 3600
"""Maximum duration of a person's connection, so that a signed-out person cannot stay connected."""
CLOUD_NAME: Final = "Telescope"
_SERVICE: Final = "service:xmpp"
_PAGE = 1000


@dataclass(frozen=True, slots=True)
class Password:
    """XMPP credentials."""

    user: str
    password: str
    expires_ms: int
    lifetime_s: int


@dataclass(frozen=True, slots=True)
class Contact:
    """A contact: user part of the JID, and display name."""

    user: str
    name: str


@dataclass(frozen=True, slots=True)
class Admitted:
    """A successful login: user, expiry time and contacts."""

    user: str
    name: str
    kind: Literal["agent", "account", "cloud"]
    lifetime_s: int
    contacts: tuple[Contact, ...]


class XmppCredentials:
    """Creates and verifies passwords.

    Args:
        tables: Agents and accounts.
        keys: Sign the passwords.
        authenticator: Issues and verifies passwords of persons.
        sign_in: Names of accounts.
        devices: Agents of an account.
        clock: Current time.
        domain: Domain part of every JID; empty: there is no XMPP server.
        browsers: Whether the server accepts connections of browsers.
    """

    def __init__(
        self,
        *,
        tables: Tables,
        keys: SigningKeys,
        authenticator: Authenticator,
        sign_in: SignIn,
        devices: DeviceAccess,
        clock: Clock,
        domain: str,
        browsers: bool,
    ) -> None:
        self._tables = tables
        self._keys = keys
        self._authenticator = authenticator
        self._sign_in = sign_in
        self._devices = devices
        self._clock = clock
        self._domain = domain
        self._browsers = browsers

    async def agent(self, agent: Agent) -> Password:
        """Credentials of an agent.

        Raises:
            Problem: ``xmpp-unavailable``, ``agent-unclaimed``.
        """
        self._require()
        require_claimed(agent)
        return await self._signed(agent.id, f"agent:{agent.id}", AGENT_S, pairing=agent.pairing)

    async def account(self, caller: Identity) -> Password:
        """Credentials of a person's XMPP client, valid as long as the sign-in session.

        Raises:
            Problem: ``xmpp-unavailable``.
        """
        self._require()
        now_ms = self._clock.now_ms()
        lifetime_s = caller.lifetime_s(SESSION_S, now_ms)
        token = await self._authenticator.issue(caller, XMPP, lifetime_s)
        return Password(caller.account, token, now_ms + lifetime_s * 1000, lifetime_s)

    async def browser(self, caller: Identity) -> tuple[Password, str]:
        """Credentials of a page that sends setpoints, and an access token for its sign-in at the gateway.

        Both are short-lived, because the XMPP server sees them.

        Raises:
            Problem: ``xmpp-unavailable``.
        """
        self._require()
        if not self._browsers:
            detail = (
                "The XMPP server accepts no browsers. Send setpoints over MQTT, or set TELESCOPE_XMPP_WEBSOCKET_URL."
            )
            raise Problem("xmpp-unavailable", 409, "No XMPP server for browsers", detail)
        now_ms = self._clock.now_ms()
        lifetime_s = caller.lifetime_s(ACCESS_S, now_ms)
        password = await self._authenticator.issue(caller, XMPP, lifetime_s)
        token = await self._authenticator.issue(caller, API, lifetime_s)
        return Password(caller.account, password, now_ms + lifetime_s * 1000, lifetime_s), token

    async def cloud(self) -> Password:
        """Credentials of the XMPP gateway.

        Raises:
            Problem: ``xmpp-unavailable``.
        """
        self._require()
        return await self._signed(jids.CLOUD, _SERVICE, AGENT_S)

    async def verify(self, user: str, password: str) -> Admitted:
        """Verify a login.

        Raises:
            Problem: ``unauthorized``: wrong or expired password; ``xmpp-unavailable``.
        """
        self._require()
        if user == jids.CLOUD:
            claims = await self._claims(password)
            if claims.get("sub") != _SERVICE:
                raise _refused()
            return Admitted(user, CLOUD_NAME, "cloud", self._left_s(claims), ())
        if len(user) == AGENT_LENGTH and is_id(user):
            return await self._verify_agent(user, password)
        return await self._verify_account(user, password)

    async def _verify_agent(self, user: str, password: str) -> Admitted:
        claims = await self._claims(password)
        _, agent = await records.find(self._tables, records.AGENTS, user, "agent", Agent)
        if agent is None or agent.account is None:
            raise _refused()
        if (claims.get("sub"), claims.get("pairing")) != (f"agent:{user}", agent.pairing):
            raise _refused()
        owner = await self._sign_in.named(agent.account)
        contacts = (Contact(jids.CLOUD, CLOUD_NAME), Contact(agent.account, owner))
        return Admitted(user, agent.name, "agent", self._left_s(claims), contacts)

    async def _verify_account(self, user: str, password: str) -> Admitted:
        caller = await self._authenticator.person(password, XMPP)
        if caller.account != user:
            raise _refused()
        contacts = [Contact(jids.CLOUD, CLOUD_NAME)]
        cursor: str | None = None
        while True:
            agents, cursor = await self._devices.agents(caller, cursor=cursor, limit=_PAGE)
            contacts += [Contact(agent.id, agent.name) for agent in agents if agent.transport == "xmpp"]
            if cursor is None:
                left_s = caller.lifetime_s(LOGIN_S, self._clock.now_ms())
                return Admitted(user, caller.name, "account", left_s, tuple(contacts))

    def _require(self) -> None:
        if not self._domain:
            detail = "No XMPP server is configured. Use another transport, or set TELESCOPE_XMPP_DOMAIN."
            raise Problem("xmpp-unavailable", 409, "No XMPP server", detail)

    async def _signed(self, user: str, subject: str, lifetime_s: int, **more: str) -> Password:
        key = await self._keys.current()
        now_s = self._clock.now_ms() // 1000
        expires_s = now_s + lifetime_s
        claims = {"iss": "telescope", "aud": XMPP, "sub": subject, "iat": now_s, "exp": expires_s, "jti": new_id()}
        claims |= more
        token = jwt.encode(claims, key, ALGORITHM, headers={"kid": signing.key_id(key.public_key())})
        return Password(user, token, expires_s * 1000, lifetime_s)

    async def _claims(self, token: str) -> dict[str, object]:
        try:
            kid = str(jwt.get_unverified_header(token)["kid"])
            key = (await self._keys.public(kid))[kid]
            return decode(token, key, XMPP, now_s=self._clock.now_ms() / 1000, leeway_s=0)
        except (jwt.PyJWTError, KeyError, ValueError) as error:
            raise _refused() from error

    def _left_s(self, claims: dict[str, object]) -> int:
        ends_s = claims["exp"]
        assert isinstance(ends_s, int | float)  # noqa: S101 (checked by `decode`)
        return max(1, int(ends_s - self._clock.now_ms() / 1000))


def _refused() -> Problem:
    return unauthorized("The XMPP name or password is wrong. Request new credentials.")
