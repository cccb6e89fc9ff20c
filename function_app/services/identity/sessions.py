"""Sign-in sessions of an account."""

from dataclasses import dataclass
from typing import Final, Literal

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Account, Identity
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.identity.authenticator import (
    ACCESS_S,
    API,
    DEVICE,
    DEVICE_S,
    SESSION,
    SESSION_S,
    Authenticator,
    new_secret,
    new_session,
)
from function_app.services.storage import records
from function_app.services.storage.retention import Retention

How = Literal["link", "password", "oidc"]
FRESH_MS: Final = 10 * 60 * 1000
"""A session by one-time link of at most this age may set a password without the old one."""
_SHOWN: Final = 200
_ROW: Final = "session:"


@dataclass(frozen=True, slots=True)
class SignInOrigin:
    """Origin of a sign-in as known from the request; visible to the account only.

    Attributes:
        program: User agent.
        device_token: Received at an earlier sign-in; not verified.
    """

    address: str = ""
    program: str = ""
    device_token: str = ""


@dataclass(frozen=True, slots=True)
class Session:
    """A sign-in as visible to its account; ``program`` is the user agent."""

    id: str
    how: How
    since_ms: int
    expires_ms: int
    address: str = ""
    program: str = ""

    def fresh_by_link(self, now_ms: int) -> bool:
        """Whether a one-time link was redeemed for it recently."""
        return self.how == "link" and 0 <= now_ms - self.since_ms < FRESH_MS


@dataclass(frozen=True, slots=True)
class SignedIn:
    """A new sign-in session. A page sends the ``csrf`` token with its HTTP-only ``cookie``.

    ``device_token`` identifies the browser at its next sign-in.
    """

    account: Account
    session: str
    access_token: str
    cookie: str
    csrf: str
    device_token: str
    expires_in_s: int = ACCESS_S
    cookie_s: int = SESSION_S


class Sessions:
    """Creates and lists sign-in sessions."""

    def __init__(
        self, *, tables: Tables, authenticator: Authenticator, retention: Retention, audit_log: AuditLog, clock: Clock
    ) -> None:
        self._tables = tables
        self._authenticator = authenticator
        self._retention = retention
        self._audit_log = audit_log
        self._clock = clock

    async def begin(self, account: Account, how: How, origin: SignInOrigin) -> SignedIn:
        """Create a session for an authenticated account."""
        now_ms = self._clock.now_ms()
        ends_ms = now_ms + SESSION_S * 1000
        session = Session(new_session(), how, now_ms, ends_ms, address=origin.address, program=origin.program[:_SHOWN])
        row = Row(account.id, _ROW + session.id, records.to_data(session))
        await self._retention.delete_row_at(records.ACCOUNTS, row.partition, row.key, due_ms=ends_ms)
        caller = Identity(account.id, account.name, session.id, until_ms=ends_ms)
        async with self._audit_log.change(
            account.id, AccountEvent.SIGNED_IN, caller, how=how, address=origin.address
        ) as change:
            await change.store_pending()
            await self._tables.create(records.ACCOUNTS, row)
        csrf = new_secret()
        device = Identity(account.id, "", await self.known_device(account.id, origin) or new_id())
        return SignedIn(
            account=account,
            session=session.id,
            access_token=await self._authenticator.issue(caller, API, ACCESS_S),
            cookie=await self._authenticator.issue(caller, SESSION, SESSION_S, csrf=csrf),
            csrf=csrf,
            device_token=await self._authenticator.issue(device, DEVICE, DEVICE_S),
        )

    async def known_device(self, account: str, origin: SignInOrigin) -> str:
        """The id of a browser or program that has signed in to ``account`` before; empty if it is not known."""
        if not origin.device_token:
            return ""
        try:
            device = await self._authenticator.person(origin.device_token, DEVICE)
        except Problem:
            return ""
        return device.session if device.account == account else ""

    async def access_token(self, caller: Identity) -> tuple[str, int]:
        """A new access token of a session and its lifetime [s], limited by the session."""
        lifetime_s = caller.lifetime_s(ACCESS_S, self._clock.now_ms())
        return await self._authenticator.issue(caller, API, lifetime_s), lifetime_s

    async def list(self, account: str) -> tuple[Session, ...]:
        """Open sessions of an account, newest first."""
        now_ms = self._clock.now_ms()
        rows = records.all_rows(self._tables, records.ACCOUNTS, account, first=_ROW, last="session;")
        sessions = [records.read(row, Session) async for row in rows]
        live = [session for session in sessions if now_ms < session.expires_ms]
        return tuple(sorted(live, key=lambda session: -session.since_ms))

    async def get(self, caller: Identity) -> Session | None:
        """The caller's own session."""
        _, session = await records.find(self._tables, records.ACCOUNTS, caller.account, _ROW + caller.session, Session)
        return session

    async def drop(self, account: str, session: str) -> bool:
        """Remove a session from the list; return whether it existed."""
        row = await self._tables.get(records.ACCOUNTS, account, _ROW + session)
        if row is None:
            return False
        try:
            await self._tables.delete(records.ACCOUNTS, row)
        except Conflict:
            return False
        return True
