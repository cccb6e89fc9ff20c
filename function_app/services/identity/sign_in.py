"""Signing in by a one-time link, and the accounts behind it."""

import hashlib

from function_app.domain.audit.hash_chain import CLOUD, AccountEvent
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem, unauthorized
from function_app.domain.identity.accounts import Account, Identity, Space, fold_name
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.identity.authenticator import new_secret
from function_app.services.identity.sessions import Sessions, SignedIn, SignInOrigin
from function_app.services.storage import records

LINK_MS = 24 * 3600 * 1000
FIRST_SPACE = "Home"
_NAME = "name:"
MOST_SPACES = 100
"""More or less: two that are made at once may both be the last."""


class SignIn:
    """Accounts and their one-time links."""

    def __init__(self, *, tables: Tables, sessions: Sessions, audit_log: AuditLog, clock: Clock) -> None:
        self._tables = tables
        self._sessions = sessions
        self._audit_log = audit_log
        self._clock = clock

    async def account(self, name: str) -> Account:
        """The local account of this name, made with its first space when there is none. It keeps its first spelling."""
        row = await self._named(name)
        return await self._account(row.partition if row else named_partition(name), name, keep=True)

    async def account_elsewhere(self, issuer: str, subject: str, name: str) -> Account:
        """The account of somebody who signs in elsewhere: by who says so and who they are there, never by a name.

        Names and e-mail addresses are given away again, and not every provider looks whose they are.
        """
        account = await self._account(_elsewhere(issuer, subject), name, keep=False)
        await records.upsert(
            self._tables,
            records.ACCOUNTS,
            account.id,
            "account",
            lambda existing: None if existing == account else account,
            Account,
        )
        return account

    async def is_known_elsewhere(self, issuer: str, subject: str) -> bool:
        """Whether somebody who signs in elsewhere has an account here."""
        return await self._tables.get(records.ACCOUNTS, _elsewhere(issuer, subject), "account") is not None

    async def _account(self, partition: str, name: str, *, keep: bool) -> Account:
        """Written so that a stop after any step leaves something the next call completes.

        Args:
            partition: Where it is written which account it is.
            name: What it is called.
            keep: It goes on being called what it was.
        """
        row = await self._tables.get(records.ACCOUNTS, partition, "account")
        if row is None:
            ids = new_name(new_id(12), name)
            try:
                row = await self._tables.create(records.ACCOUNTS, Row(partition, "account", ids))
            except Conflict:
                return await self._account(partition, name, keep=keep)
        account = _of(row, name) if keep else Account(id=str(row.data["account"]), name=name)
        spaces = await self.spaces(account.id)
        if not spaces:
            space = Space(id=str(row.data["space"]), name=FIRST_SPACE)
            # The space last: as long as it is not there, all of this is done again.
            await self._create(Row(account.id, "account", records.to_data(account)))
            await self._create(Row(account.id, f"space:{space.id}", records.to_data(space)))
        return account

    async def spaces(self, account: str) -> tuple[Space, ...]:
        """The spaces of an account, the oldest first."""
        page = await self._tables.query(records.ACCOUNTS, account, first="space:", last="space;", limit=1000)
        return tuple(sorted((records.read(row, Space) for row in page.rows), key=lambda space: space.created_ms))

    async def add_space(self, caller: Identity, name: str) -> Space:
        """A further space.

        Raises:
            Problem: ``too-many-spaces``.
        """
        if len(await self.spaces(caller.account)) >= MOST_SPACES:
            detail = f"An account has at most {MOST_SPACES} spaces. Use one of them."
            raise Problem("too-many-spaces", 409, "Too many spaces", detail)
        space = Space(id=new_id(12), name=name, created_ms=self._clock.now_ms())
        async with self._audit_log.change(
            caller.account, AccountEvent.SPACE_MADE, caller, on=space.id, name=name
        ) as change:
            await change.noted()
            await self._tables.create(
                records.ACCOUNTS, Row(caller.account, f"space:{space.id}", records.to_data(space))
            )
        return space

    async def known(self, name: str) -> Account | None:
        """The local account of this name, in whatever spelling; under the one that it was made with."""
        row = await self._named(name)
        return _of(row, name) if row else None

    async def named(self, account: str) -> str:
        """The name of an account; empty when it is gone."""
        row = await self._tables.get(records.ACCOUNTS, account, "account")
        return records.read(row, Account).name if row else ""

    async def link(self, account: Account) -> str:
        """A new one-time token that signs in to ``account``, good for a day. Only its hash is stored."""
        token = new_secret()
        hashed = _hash(token)
        data = {"account": account.id, "name": account.name, "expires_ms": self._clock.now_ms() + LINK_MS}
        await self._tables.create(records.SIGN_INS, Row(hashed[0], hashed, data))
        return token

    async def redeem(self, token: str, whence: SignInOrigin | None = None) -> SignedIn:
        """Sign in. Of several that bring the same token one wins: whoever deletes the row.

        Raises:
            Problem: ``unauthorized``: unknown, used or expired; the answer is the same.
        """
        hashed = _hash(token)
        refused = unauthorized("This sign-in link is unknown, used or expired. Ask for a new one.")
        row = await self._tables.get(records.SIGN_INS, hashed[0], hashed)
        if row is None:
            address = whence.address if whence else ""
            await self._audit_log.record_rejection(
                CLOUD, AccountEvent.SIGN_IN_REFUSED, None, code="link-unknown", address=address
            )
            raise refused
        try:
            await self._tables.delete(records.SIGN_INS, row)
        except Conflict as conflict:
            raise refused from conflict
        if self._clock.now_ms() >= row.data["expires_ms"]:
            raise refused
        account = Account(id=row.data["account"], name=row.data["name"])
        return await self._sessions.begin(account, "link", whence or SignInOrigin())

    async def _named(self, name: str) -> Row | None:
        """Rows from before names were folded are under their own spelling: by that they are found, and first."""
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
    """Where it is written which local account has a name."""
    return f"{_NAME}{fold_name(name)}"


def new_name(account: str, name: str) -> dict[str, str]:
    """What is written there of a new account."""
    return {"account": account, "space": new_id(12), "name": name}


def _of(row: Row, name: str) -> Account:
    """The account that a name leads to. Where the row does not say how it is spelt, it was found by its spelling."""
    return Account(id=str(row.data["account"]), name=str(row.data.get("name", name)))


def _elsewhere(issuer: str, subject: str) -> str:
    digest = hashlib.sha256(f"{issuer}\n{subject}".encode()).hexdigest()
    return f"open-id:{digest}"


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
