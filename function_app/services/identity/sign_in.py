"""Sign-in by one-time link, and account creation."""

import contextlib
import hashlib

from function_app.domain.audit.hash_chain import CLOUD, AccountEvent
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem, unauthorized
from function_app.domain.common.text import clean_label
from function_app.domain.identity.accounts import Account, Identity, Space, fold_name
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.identity.account_names import reserve_name, reserve_new_name
from function_app.services.identity.authenticator import new_secret
from function_app.services.identity.second_factor import SecondFactor, Used, sign_in_counter
from function_app.services.identity.sessions import Sessions, SignedIn, SignInOrigin
from function_app.services.storage import records

LINK_MS = 24 * 3600 * 1000
FIRST_SPACE = "Home"
_NAME = "name:"
MOST_SPACES = 100
"""Approximate maximum: concurrent requests may exceed it by one."""


class SignIn:
    """Accounts and their one-time links."""

    def __init__(
        self, *, tables: Tables, sessions: Sessions, second_factor: SecondFactor, audit_log: AuditLog, clock: Clock
    ) -> None:
        self._tables = tables
        self._sessions = sessions
        self._second_factor = second_factor
        self._audit_log = audit_log
        self._clock = clock

    async def account(self, name: str) -> Account:
        """The local account with this name, created with its first space if missing. The first spelling is kept.

        Raises ``name-invalid``, or ``name-taken``: the name of a new account looks like an existing one.
        """
        row = await self._named(name)
        return await self._account(row.partition if row else named_partition(name), name, keep=True)

    async def oidc_account(self, issuer: str, subject: str, name: str) -> Account:
        """The account of a person at an OIDC provider, identified by issuer and subject: names may be reassigned."""
        account = await self._account(_oidc_partition(issuer, subject), name, keep=False)
        await records.upsert(
            self._tables,
            records.ACCOUNTS,
            account.id,
            "account",
            lambda existing: None if existing == account else account,
            Account,
        )
        return account

    async def has_oidc_account(self, issuer: str, subject: str) -> bool:
        """Whether an account exists for a person at an OIDC provider."""
        return await self._tables.get(records.ACCOUNTS, _oidc_partition(issuer, subject), "account") is not None

    async def _account(self, partition: str, name: str, *, keep: bool) -> Account:
        """Create or complete an account; ``keep`` its display name. The next call completes an interrupted creation."""
        row = await self._tables.get(records.ACCOUNTS, partition, "account")
        if row is None:
            if keep:
                await reserve_new_name(self._tables, name)
            ids = new_name(new_id(12), name)
            try:
                row = await self._tables.create(records.ACCOUNTS, Row(partition, "account", ids))
            except Conflict:
                return await self._account(partition, name, keep=keep)
        account = _of(row, name) if keep else Account(id=str(row.data["account"]), name=clean_label(name))
        spaces = await self.spaces(account.id)
        if not spaces:
            space = Space(id=str(row.data["space"]), name=FIRST_SPACE)
            # The space is written last: while it is missing, all steps are repeated.
            await self._create(Row(account.id, "account", records.to_data(account)))
            await self._create(Row(account.id, f"space:{space.id}", records.to_data(space)))
        return account

    async def spaces(self, account: str) -> tuple[Space, ...]:
        """Spaces of an account, oldest first."""
        page = await self._tables.query(records.ACCOUNTS, account, first="space:", last="space;", limit=1000)
        return tuple(sorted((records.read(row, Space) for row in page.rows), key=lambda space: space.created_ms))

    async def add_space(self, caller: Identity, name: str) -> Space:
        """Create a space. Raises ``too-many-spaces``."""
        if len(await self.spaces(caller.account)) >= MOST_SPACES:
            detail = f"An account has at most {MOST_SPACES} spaces. Use one of them."
            raise Problem("too-many-spaces", 409, "Too many spaces", detail)
        space = Space(id=new_id(12), name=name, created_ms=self._clock.now_ms())
        async with self._audit_log.change(
            caller.account, AccountEvent.SPACE_MADE, caller, on=space.id, name=name
        ) as change:
            await change.store_pending()
            await self._tables.create(
                records.ACCOUNTS, Row(caller.account, f"space:{space.id}", records.to_data(space))
            )
        return space

    async def known(self, name: str) -> Account | None:
        """The local account with this name in any spelling, with its original name."""
        row = await self._named(name)
        return _of(row, name) if row else None

    async def protect_name(self, account: Account) -> None:
        """Reserve the names that look like the one of an account that was created before such names were rejected."""
        with contextlib.suppress(Problem):
            await reserve_name(self._tables, account.name)

    async def named(self, account: str) -> str:
        """The name of an account; empty if it does not exist."""
        row = await self._tables.get(records.ACCOUNTS, account, "account")
        return records.read(row, Account).name if row else ""

    async def link(self, account: Account) -> str:
        """A new one-time sign-in token for ``account``, valid for one day. Only its hash is stored."""
        token = new_secret()
        hashed = _hash(token)
        data = {"account": account.id, "name": account.name, "expires_ms": self._clock.now_ms() + LINK_MS}
        await self._tables.create(records.SIGN_INS, Row(hashed[0], hashed, data))
        return token

    async def redeem(self, token: str, origin: SignInOrigin | None = None, code: str = "") -> SignedIn:
        """Sign in with a one-time token, and ``code`` if the account has a second factor.

        Of concurrent requests one succeeds: the one that deletes the row. A wrong code does not use up the token.

        Raises:
            Problem: ``unauthorized``: unknown, used or expired; the response is the same; ``second-factor-required``,
                ``second-factor-wrong``, ``too-many-tries``.
        """
        origin = origin or SignInOrigin()
        hashed = _hash(token)
        refused = unauthorized("This sign-in link is unknown, used or expired. Request a new one.")
        row = await self._tables.get(records.SIGN_INS, hashed[0], hashed)
        if row is None:
            await self._audit_log.record_rejection(
                CLOUD, AccountEvent.SIGN_IN_REJECTED, None, code="link-unknown", address=origin.address
            )
            raise refused
        account = Account(id=row.data["account"], name=row.data["name"])
        expired = self._clock.now_ms() >= row.data["expires_ms"]
        used: Used = "" if expired else await self.check_second_factor(account.id, code, origin)
        try:
            await self._tables.delete(records.SIGN_INS, row)
        except Conflict as conflict:
            raise refused from conflict
        if expired:
            raise refused
        return await self._sessions.begin(account, "link", origin, second_factor=used)

    async def check_second_factor(self, account: str, code: str, origin: SignInOrigin) -> Used:
        """Check the second factor of a sign-in. Raises like ``SecondFactor.check``."""
        device = await self._sessions.known_device(account, origin)
        return await self._second_factor.check(account, code, origin, counter=sign_in_counter(account, device))

    async def _named(self, name: str) -> Row | None:
        """Older rows are stored under their exact spelling, which is looked up first."""
        for partition in dict.fromkeys((f"{_NAME}{name}", named_partition(name))):
            row = await self._tables.get(records.ACCOUNTS, partition, "account")
            if row is not None:
                return row
        return None

    async def _create(self, row: Row) -> None:
        try:
            await self._tables.create(records.ACCOUNTS, row)
        except Conflict:
            return


def named_partition(name: str) -> str:
    """Partition that maps a name to a local account."""
    return f"{_NAME}{fold_name(name)}"


def new_name(account: str, name: str) -> dict[str, str]:
    """The row of a new name."""
    return {"account": account, "space": new_id(12), "name": name}


def _of(row: Row, name: str) -> Account:
    """The account of a name row. Rows without a spelling were found by their exact spelling."""
    return Account(id=str(row.data["account"]), name=str(row.data.get("name", name)))


def _oidc_partition(issuer: str, subject: str) -> str:
    digest = hashlib.sha256(f"{issuer}\n{subject}".encode()).hexdigest()
    return f"open-id:{digest}"


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
