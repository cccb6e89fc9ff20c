"""Signing in by a one-time link, and the accounts behind it."""

import hashlib

from function_app.domain.accounts import Account, Identity, Space
from function_app.domain.audit_chain import CLOUD, Deed
from function_app.domain.ids import new_id
from function_app.domain.problems import Problem, unauthorized
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services import store
from function_app.services.audit_chain import AuditChain
from function_app.services.identity import new_secret
from function_app.services.sessions import From, Sessions, SignedIn

LINK_MS = 24 * 3600 * 1000
FIRST_SPACE = "Home"
MOST_SPACES = 100
"""More or less: two that are made at once may both be the last."""


class SignIn:
    """Accounts and their one-time links."""

    def __init__(self, *, tables: Tables, sessions: Sessions, chain: AuditChain, clock: Clock) -> None:
        self._tables = tables
        self._sessions = sessions
        self._chain = chain
        self._clock = clock

    async def account(self, name: str) -> Account:
        """The local account of this name, made with its first space when there is none."""
        return await self._account(named_partition(name), name)

    async def account_elsewhere(self, issuer: str, subject: str, name: str) -> Account:
        """The account of somebody who signs in elsewhere: by who says so and who they are there, never by a name.

        Names and e-mail addresses are given away again, and not every provider looks whose they are.
        """
        digest = hashlib.sha256(f"{issuer}\n{subject}".encode()).hexdigest()
        account = await self._account(f"open-id:{digest}", name)
        await store.upsert(
            self._tables,
            store.ACCOUNTS,
            account.id,
            "account",
            lambda known: None if known == account else account,
            Account,
        )
        return account

    async def _account(self, partition: str, name: str) -> Account:
        """Written so that a stop after any step leaves something the next call completes."""
        row = await self._tables.get(store.ACCOUNTS, partition, "account")
        if row is None:
            ids = {"account": new_id(12), "space": new_id(12)}
            try:
                row = await self._tables.create(store.ACCOUNTS, Row(partition, "account", ids))
            except Conflict:
                return await self._account(partition, name)
        account = Account(id=str(row.data["account"]), name=name)
        spaces = await self.spaces(account.id)
        if not spaces:
            space = Space(id=str(row.data["space"]), name=FIRST_SPACE)
            # The space last: as long as it is not there, all of this is done again.
            await self._create(Row(account.id, "account", store.fields(account)))
            await self._create(Row(account.id, f"space:{space.id}", store.fields(space)))
        return account

    async def spaces(self, account: str) -> tuple[Space, ...]:
        """The spaces of an account, the oldest first."""
        page = await self._tables.query(store.ACCOUNTS, account, first="space:", last="space;", limit=1000)
        return tuple(sorted((store.read(row, Space) for row in page.rows), key=lambda space: space.created_ms))

    async def add_space(self, who: Identity, name: str) -> Space:
        """A further space.

        Raises:
            Problem: ``too-many-spaces``.
        """
        if len(await self.spaces(who.account)) >= MOST_SPACES:
            detail = f"An account has at most {MOST_SPACES} spaces. Use one of them."
            raise Problem("too-many-spaces", 409, "Too many spaces", detail)
        space = Space(id=new_id(12), name=name, created_ms=self._clock.now_ms())
        async with self._chain.change(who.account, Deed.SPACE_MADE, who, on=space.id, name=name) as change:
            await change.noted()
            await self._tables.create(store.ACCOUNTS, Row(who.account, f"space:{space.id}", store.fields(space)))
        return space

    async def known(self, name: str) -> Account | None:
        """The account of this name, if there is one."""
        row = await self._tables.get(store.ACCOUNTS, f"name:{name}", "account")
        return Account(id=str(row.data["account"]), name=name) if row else None

    async def named(self, account: str) -> str:
        """The name of an account; empty when it is gone."""
        row = await self._tables.get(store.ACCOUNTS, account, "account")
        return store.read(row, Account).name if row else ""

    async def link(self, account: Account) -> str:
        """A new one-time token that signs in to ``account``, good for a day. Only its hash is stored."""
        token = new_secret()
        hashed = _hash(token)
        data = {"account": account.id, "name": account.name, "expires_ms": self._clock.now_ms() + LINK_MS}
        await self._tables.create(store.SIGN_INS, Row(hashed[0], hashed, data))
        return token

    async def redeem(self, token: str, whence: From | None = None) -> SignedIn:
        """Sign in. Of several that bring the same token one wins: whoever deletes the row.

        Raises:
            Problem: ``unauthorized``: unknown, used or expired; the answer is the same.
        """
        hashed = _hash(token)
        refused = unauthorized("This sign-in link is unknown, used or expired. Ask for a new one.")
        row = await self._tables.get(store.SIGN_INS, hashed[0], hashed)
        if row is None:
            address = whence.address if whence else ""
            await self._chain.refused(CLOUD, Deed.SIGN_IN_REFUSED, None, code="link-unknown", address=address)
            raise refused
        try:
            await self._tables.delete(store.SIGN_INS, row)
        except Conflict as conflict:
            raise refused from conflict
        if self._clock.now_ms() >= row.data["expires_ms"]:
            raise refused
        account = Account(id=row.data["account"], name=row.data["name"])
        return await self._sessions.begin(account, "link", whence or From())

    async def _create(self, row: Row) -> None:
        try:
            await self._tables.create(store.ACCOUNTS, row)
        except Conflict:
            return


def named_partition(name: str) -> str:
    """Where it is written which local account has a name."""
    return f"name:{name}"


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
