"""Passwords of local accounts: sign-in, change, and registration."""

import asyncio
import hashlib
from dataclasses import dataclass
from typing import Final

from function_app.domain.audit.hash_chain import CLOUD, AccountEvent
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem, forbidden, invalid, unauthorized
from function_app.domain.identity.accounts import Account, Identity
from function_app.domain.identity.passwords import normalize, weakness
from function_app.ports.clock import Clock
from function_app.ports.password_hasher import PasswordHasher
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.accounts.sign_out import SignOut
from function_app.services.audit.audit_log import AuditLog
from function_app.services.identity.account_names import reserve_new_name
from function_app.services.identity.guess_limiter import Guess, GuessLimiter, by_address
from function_app.services.identity.sessions import Sessions, SignedIn, SignInOrigin
from function_app.services.identity.sign_in import SignIn, named_partition, new_name
from function_app.services.storage import records

GUESS: Final = Guess("password", 300_000, "Too many wrong passwords.")
WRONG_TRIES: Final = 10
"""Per account and address, and per known browser of an account, in five minutes."""
WRONG_TRIES_FROM: Final = 30
"""Per address; an address may serve many people."""
SLOW_AFTER: Final = 100
"""Attempts per account in five minutes from all addresses; further ones are delayed. They are never rejected, because
an attacker with many addresses must not lock the owner out."""
SLOWEST_S: Final = 4.0
"""Longest delay of an attempt [s]."""
SLOWER_S: Final = 0.05
"""Additional delay per attempt beyond ``SLOW_AFTER`` [s]."""
_NO_LIMIT: Final = 2**53
WRONG: Final = "wrong-password"
_PASSWORD: Final = "password"  # noqa: S105 (the key of a row)
_NO_ACCOUNT: Final = "name:"
"""Partition without an account, so that an unknown name costs the same reads."""


@dataclass(frozen=True, slots=True)
class _Stored:
    hash: str
    changed_ms: int


class Passwords:
    """Manages passwords, of which only hashes are stored."""

    def __init__(
        self,
        *,
        tables: Tables,
        hasher: PasswordHasher,
        guess_limiter: GuessLimiter,
        sign_in: SignIn,
        sessions: Sessions,
        sign_out: SignOut,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._hasher = hasher
        self._guess_limiter = guess_limiter
        self._sign_in = sign_in
        self._sessions = sessions
        self._sign_out = sign_out
        self._audit_log = audit_log
        self._clock = clock

    async def sign_in(self, name: str, password: str, origin: SignInOrigin, code: str = "") -> SignedIn:
        """Sign in, with ``code`` if the account has a second factor. For unknown names, time and response are the same.

        Raises ``unauthorized``, ``second-factor-required``, ``second-factor-wrong`` or ``too-many-tries``.
        """
        account_of_name = await self._sign_in.known(name)
        account = account_of_name.id if account_of_name else ""
        counters = _counters(name, origin.address, await self._sessions.known_device(account, origin))
        try:
            tries = await self._guess_limiter.add_failure(GUESS, counters)
        except Problem as problem:
            await self._refused("", origin, problem.code)
            raise
        await asyncio.sleep(min(SLOWEST_S, SLOWER_S * max(0, tries - SLOW_AFTER)))
        row, stored = await records.find(self._tables, records.ACCOUNTS, account or _NO_ACCOUNT, _PASSWORD, _Stored)
        valid = await self._hasher.check(stored.hash if stored else None, normalize(password))
        if account_of_name is None or row is None or stored is None or not valid:
            await self._refused(account, origin, WRONG)
            raise unauthorized("Name or password is wrong.")
        await self._guess_limiter.remove_failure(GUESS, counters)
        await self._sign_in.protect_name(account_of_name)
        used = await self._sign_in.check_second_factor(account, code, origin)
        signed_in = await self._sessions.begin(account_of_name, "password", origin, second_factor=used)
        current = await self._tables.get(records.ACCOUNTS, account, _PASSWORD)
        if current is None or records.read(current, _Stored) != stored:
            # A concurrent password change has ended all earlier sessions, but not this one.
            await self._sign_out.end(Identity(account, account_of_name.name, signed_in.session))
            raise unauthorized("The password was changed. Sign in with the new one.")
        if self._hasher.outdated(stored.hash):
            await self._renew(current, password)
        return signed_in

    async def put(self, caller: Identity, password: str, *, old: str | None, origin: SignInOrigin) -> None:
        """Set or change the caller's password; all other sessions of the account end.

        Requires the old password, except in the first minutes after a sign-in by one-time link. An open page alone is
        not sufficient to take over the account.
        Raises ``password-not-managed-here``, ``forbidden``, ``password-weak`` or ``too-many-tries``.
        """
        row = await self.prove(caller, old, origin)
        data = records.to_data(await self._store(password, caller.name))
        async with self._audit_log.change(
            caller.account, AccountEvent.PASSWORD_SET, caller, address=origin.address
        ) as change:
            await change.store_pending()
            try:
                if row is None:
                    await self._tables.create(records.ACCOUNTS, Row(caller.account, _PASSWORD, data))
                else:
                    await self._tables.replace(records.ACCOUNTS, row.changed(data))
            except Conflict as conflict:
                detail = "The password was changed concurrently. Use the new one as the old password."
                raise forbidden(detail) from conflict
        await self._sign_out.others(caller)

    async def prove(self, caller: Identity, password: str | None, origin: SignInOrigin) -> Row | None:
        """Require the password of the caller's local account, or a recent sign-in by link; return the password's row.

        Raises ``password-not-managed-here``, ``forbidden`` or ``too-many-tries``.
        """
        account_of_name = await self._sign_in.known(caller.name)
        if account_of_name is None or account_of_name.id != caller.account:
            detail = "This account signs in with a provider and has no password here. Change it at the provider."
            raise Problem("password-not-managed-here", 409, "No local password", detail)
        row = await self._tables.get(records.ACCOUNTS, caller.account, _PASSWORD)
        await self._require_right(caller, row, password, origin)
        return row

    async def register(self, name: str, password: str) -> Account:
        """Create a local account. The password is written before the name, so that no name exists without a password.

        Raises ``name-invalid``, ``name-taken`` or ``password-weak``.
        """
        taken = Problem("name-taken", 409, "The name is taken", "Another account has this name. Choose another name.")
        if await self._sign_in.known(name) is not None:
            raise taken
        stored = await self._store(password, name)
        await reserve_new_name(self._tables, name)
        account = new_id(12)
        row = await self._tables.create(records.ACCOUNTS, Row(account, _PASSWORD, records.to_data(stored)))
        try:
            async with self._audit_log.change(
                account, AccountEvent.ACCOUNT_MADE, Identity(account, name, "")
            ) as change:
                await change.store_pending()
                await self._tables.create(
                    records.ACCOUNTS, Row(named_partition(name), "account", new_name(account, name))
                )
        except Conflict as conflict:
            await self._tables.delete(records.ACCOUNTS, row)
            raise taken from conflict
        return await self._sign_in.account(name)

    async def _refused(self, account: str, origin: SignInOrigin, code: str) -> None:
        """Record each failure, also of unknown names, so that they take the same time."""
        wrong = code == WRONG
        data = {"code": code, "address": origin.address}
        await self._audit_log.record_rejection(
            account or CLOUD, AccountEvent.SIGN_IN_REJECTED, None, each=wrong, **data
        )

    async def _require_right(self, caller: Identity, row: Row | None, old: str | None, origin: SignInOrigin) -> None:
        if old is None:
            session = await self._sessions.get(caller)
            if session is None or not session.fresh_by_link(self._clock.now_ms()):
                raise forbidden(
                    "Enter your current password, or sign in with a new one-time link and repeat this in 10 minutes."
                )
            return
        counters = {f"session:{caller.session}": WRONG_TRIES}
        await self._guess_limiter.add_failure(GUESS, counters)
        if not await self._hasher.check(records.read(row, _Stored).hash if row else None, normalize(old)):
            await self._refused(caller.account, origin, WRONG)
            raise forbidden("The current password is wrong.")
        await self._guess_limiter.remove_failure(GUESS, counters)

    async def _store(self, password: str, name: str) -> _Stored:
        password = normalize(password)
        why = weakness(password, name=name)
        if why:
            raise invalid(why, code="password-weak")
        return _Stored(await self._hasher.make(password), self._clock.now_ms())

    async def _renew(self, row: Row, password: str) -> None:
        """Store the password with current parameters."""
        created = _Stored(await self._hasher.make(normalize(password)), self._clock.now_ms())
        try:
            await self._tables.replace(records.ACCOUNTS, row.changed(records.to_data(created)))
        except Conflict:
            return  # changed concurrently


def _counters(name: str, address: str, device: str) -> dict[str, int]:
    """The counters of an attempt. The last one counts all attempts for the account and has no limit.

    Count by address first: beyond its limit, invented names create no rows. A known ``device`` has its own counter, so
    attempts of others do not affect it.
    """
    if device:
        return {f"device:{device}": WRONG_TRIES}
    partition = f"name:{hashlib.sha256(named_partition(name).encode()).hexdigest()}"
    return {**by_address(address, WRONG_TRIES_FROM), f"{partition}@{address}": WRONG_TRIES, partition: _NO_LIMIT}
