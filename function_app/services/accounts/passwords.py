"""Local accounts' passwords: signing in by one, setting and changing it, an account made with one."""

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
from function_app.services.identity.guess_limiter import Guess, GuessLimiter, by_address
from function_app.services.identity.sessions import Sessions, SignedIn, SignInOrigin
from function_app.services.identity.sign_in import SignIn, named_partition, new_name
from function_app.services.storage import records

GUESS: Final = Guess("password", 300_000, "Too many wrong passwords.")
WRONG_TRIES: Final = 10
"""By one account in five minutes: in a year a million, of more than 10²⁰ that twelve characters can be. NIST SP 800-63B
allows a hundred in a row."""
WRONG_TRIES_FROM: Final = 30
"""From one address: behind one may be a whole school."""
WRONG: Final = "wrong-password"
_PASSWORD: Final = "password"  # noqa: S105 (the key of a row)
_NOBODY: Final = "name:"
"""A partition of no account: a name that nobody has costs the same reads."""


@dataclass(frozen=True, slots=True)
class _Stored:
    hash: str
    changed_ms: int


class Passwords:
    """Passwords, of which only hashes are stored."""

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

    async def sign_in(self, name: str, password: str, whence: SignInOrigin) -> SignedIn:
        """Sign in by name and password. An unknown name takes as long as a wrong password, and is answered the same.

        Raises:
            Problem: ``unauthorized``; ``too-many-tries`` for this name, or from this address.
        """
        # The address first: once it has had its tries, names that it makes up leave no rows.
        counters = {**by_address(whence.address, WRONG_TRIES_FROM), named_partition(name): WRONG_TRIES}
        try:
            await self._guess_limiter.add_failure(GUESS, counters)
        except Problem as problem:
            await self._refused("", whence, problem.code)
            raise
        named = await self._sign_in.known(name)
        account = named.id if named else ""
        row = await self._tables.get(records.ACCOUNTS, account or _NOBODY, _PASSWORD)
        stored = records.read(row, _Stored) if row else None
        right = await self._hasher.check(stored.hash if stored else None, normalize(password))
        if named is None or row is None or stored is None or not right:
            await self._refused(account, whence, WRONG)
            raise unauthorized("This name and password do not belong together.")
        await self._guess_limiter.remove_failure(GUESS, counters)
        done = await self._sessions.begin(named, "password", whence)
        again = await self._tables.get(records.ACCOUNTS, account, _PASSWORD)
        if again is None or records.read(again, _Stored) != stored:
            # It was changed while this was looked at: that ended the sessions that it saw, not this one.
            await self._sign_out.end(Identity(account, named.name, done.session))
            raise unauthorized("The password was changed just now. Sign in with the new one.")
        if self._hasher.outdated(stored.hash):
            await self._renew(again, password)
        return done

    async def put(self, caller: Identity, password: str, *, old: str | None, whence: SignInOrigin) -> None:
        """Set or change the password of one's own account; every other session of it ends.

        The old one has to be given, except in the first minutes after a one-time link was redeemed: whoever finds a
        page that is signed in does not keep the account.

        Raises:
            Problem: ``password-not-managed-here``, ``forbidden``, ``password-weak``, ``too-many-tries``.
        """
        named = await self._sign_in.known(caller.name)
        if named is None or named.id != caller.account:
            detail = "This account signs in elsewhere and has no password here. Change it there."
            raise Problem("password-not-managed-here", 409, "No password here", detail)
        row = await self._tables.get(records.ACCOUNTS, caller.account, _PASSWORD)
        await self._require_right(caller, row, old, whence)
        data = records.to_data(await self._store(password, caller.name))
        async with self._audit_log.change(
            caller.account, AccountEvent.PASSWORD_SET, caller, address=whence.address
        ) as change:
            await change.noted()
            try:
                if row is None:
                    await self._tables.create(records.ACCOUNTS, Row(caller.account, _PASSWORD, data))
                else:
                    await self._tables.replace(records.ACCOUNTS, Row(caller.account, _PASSWORD, data, row.etag))
            except Conflict as conflict:
                detail = "The password was changed in the meantime. Give the new one as the old one."
                raise forbidden(detail) from conflict
        await self._sign_out.others(caller)

    async def register(self, name: str, password: str) -> Account:
        """A new local account. Its password is there before its name: a name without one would be nobody's.

        Raises:
            Problem: ``name-taken``, ``password-weak``.
        """
        taken = Problem("name-taken", 409, "The name is taken", "Somebody has this name. Choose another.")
        if await self._sign_in.known(name) is not None:
            raise taken
        stored = await self._store(password, name)
        account = new_id(12)
        row = await self._tables.create(records.ACCOUNTS, Row(account, _PASSWORD, records.to_data(stored)))
        try:
            async with self._audit_log.change(
                account, AccountEvent.ACCOUNT_MADE, Identity(account, name, "")
            ) as change:
                await change.noted()
                await self._tables.create(
                    records.ACCOUNTS, Row(named_partition(name), "account", new_name(account, name))
                )
        except Conflict as conflict:
            await self._tables.delete(records.ACCOUNTS, row)
            raise taken from conflict
        return await self._sign_in.account(name)

    async def _refused(self, account: str, whence: SignInOrigin, code: str) -> None:
        """Record it with the account that was meant, or, where there is none of that name, with the cloud's own.

        Each wrong password, for there are few, so that a name that nobody has takes as long as one that is known.
        """
        wrong = code == WRONG
        data = {"code": code, "address": whence.address}
        await self._audit_log.record_rejection(account or CLOUD, AccountEvent.SIGN_IN_REFUSED, None, each=wrong, **data)

    async def _require_right(self, caller: Identity, row: Row | None, old: str | None, whence: SignInOrigin) -> None:
        if old is None:
            session = await self._sessions.get(caller)
            if session is None or not session.fresh_by_link(self._clock.now_ms()):
                raise forbidden(
                    "Give the old password, or sign in by a new one-time link and set it within 10 minutes."
                )
            return
        counters = {**by_address(whence.address, WRONG_TRIES_FROM), named_partition(caller.name): WRONG_TRIES}
        await self._guess_limiter.add_failure(GUESS, counters)
        if not await self._hasher.check(records.read(row, _Stored).hash if row else None, normalize(old)):
            await self._refused(caller.account, whence, WRONG)
            raise forbidden("The old password is not right.")
        await self._guess_limiter.remove_failure(GUESS, counters)

    async def _store(self, password: str, name: str) -> _Stored:
        password = normalize(password)
        why = weakness(password, name=name)
        if why:
            raise invalid(why, code="password-weak")
        return _Stored(await self._hasher.make(password), self._clock.now_ms())

    async def _renew(self, row: Row, password: str) -> None:
        """The same password under today's parameters."""
        created = _Stored(await self._hasher.make(normalize(password)), self._clock.now_ms())
        try:
            await self._tables.replace(
                records.ACCOUNTS, Row(row.partition, row.key, records.to_data(created), row.etag)
            )
        except Conflict:
            return  # it was changed just now
