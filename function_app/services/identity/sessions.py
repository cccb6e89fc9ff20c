"""Sign-in sessions of an account, and its recent sign-ins."""

from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Final, Literal

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem
from function_app.domain.common.timestamps import LAST_MS
from function_app.domain.identity.accounts import Account, Identity
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
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
USE_MS: Final = 5 * 60 * 1000
"""Resolution of the last use of a session [ms]."""
SIGN_INS_MS: Final = 30 * 86_400_000
"""How long a sign-in is listed [ms]."""
MOST_SIGN_INS: Final = 50
"""Listed sign-ins; older ones are in the audit log."""
_REMEMBERED_USES: Final = 4096
_SHOWN: Final = 200
_ROW: Final = "session:"
_SIGN_IN: Final = "sign-in:"


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
    """A session as visible to its account.

    Attributes:
        address: Of the last use.
        program: User agent of the last use.
        used_ms: Last use, with a resolution of ``USE_MS``; 0: not since the sign-in.
    """

    id: str
    how: How
    since_ms: int
    expires_ms: int
    address: str = ""
    program: str = ""
    used_ms: int = 0

    def fresh_by_link(self, now_ms: int) -> bool:
        """Whether a one-time link was redeemed for it recently."""
        return self.how == "link" and 0 <= now_ms - self.since_ms < FRESH_MS


@dataclass(frozen=True, slots=True)
class PastSignIn:
    """A sign-in as visible to its account, also after the end of its session.

    Attributes:
        known_browser: The browser or program had signed in to the account before.
    """

    session: str
    how: How
    at_ms: int
    expires_ms: int
    address: str
    program: str
    known_browser: bool


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
        self._used_ms: OrderedDict[str, int] = OrderedDict()

    async def begin(self, account: Account, how: How, origin: SignInOrigin, *, second_factor: str = "") -> SignedIn:
        """Create a session for an authenticated account. ``second_factor``: the used one, for the audit log."""
        now_ms = self._clock.now_ms()
        ends_ms = now_ms + SESSION_S * 1000
        address, program = origin.address, origin.program[:_SHOWN]
        session = Session(new_session(), how, now_ms, ends_ms, address, program)
        caller = Identity(account.id, account.name, session.id, until_ms=ends_ms)
        known = await self.known_device(account.id, origin)
        sign_in = PastSignIn(session.id, how, now_ms, now_ms + SIGN_INS_MS, address, program, bool(known))
        async with self._audit_log.change(
            account.id,
            AccountEvent.SIGNED_IN,
            caller,
            how=how,
            address=address,
            program=program,
            known_browser=bool(known),
            second_factor=second_factor,
        ) as change:
            await change.store_pending()
            await self._store(account.id, _ROW + session.id, session)
            # Newest first.
            await self._store(account.id, f"{_SIGN_IN}{LAST_MS - now_ms:013d}:{session.id}", sign_in)
        csrf = new_secret()
        device = Identity(account.id, "", known or new_id())
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

    def use_is_due(self, caller: Identity) -> bool:
        """Whether the use of a person's session was not noted recently by this process."""
        return not caller.key and self._clock.now_ms() - self._used_ms.get(caller.session, 0) >= USE_MS

    async def note_use(self, caller: Identity, origin: SignInOrigin) -> None:
        """Store the time, address and program of this use. Does not create a session that has ended."""
        now_ms = self._clock.now_ms()
        self._used_ms[caller.session] = now_ms
        self._used_ms.move_to_end(caller.session)
        while len(self._used_ms) > _REMEMBERED_USES or now_ms - next(iter(self._used_ms.values())) >= USE_MS:
            self._used_ms.popitem(last=False)

        def used(session: Session | None) -> Session | None:
            if session is None or now_ms - max(session.since_ms, session.used_ms) < USE_MS:
                return None
            return replace(session, used_ms=now_ms, address=origin.address, program=origin.program[:_SHOWN])

        key = _ROW + caller.session
        await records.upsert(self._tables, records.ACCOUNTS, caller.account, key, used, Session)

    async def sign_ins(self, account: str) -> tuple[PastSignIn, ...]:
        """Recent sign-ins of an account, newest first."""
        page = await self._tables.query(records.ACCOUNTS, account, first=_SIGN_IN, last="sign-in;", limit=MOST_SIGN_INS)
        now_ms = self._clock.now_ms()
        sign_ins = (records.read(row, PastSignIn) for row in page.rows)
        return tuple(each for each in sign_ins if now_ms < each.expires_ms)

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

        async def attempt() -> bool:
            row = await self._tables.get(records.ACCOUNTS, account, _ROW + session)
            if row is None:
                return False
            await self._tables.delete(records.ACCOUNTS, row)
            return True

        return await records.retry(attempt)

    async def _store(self, account: str, key: str, record: Session | PastSignIn) -> None:
        """Store a new record until its expiry time."""
        await self._retention.delete_row_at(records.ACCOUNTS, account, key, due_ms=record.expires_ms)
        await self._tables.create(records.ACCOUNTS, Row(account, key, records.to_data(record)))
