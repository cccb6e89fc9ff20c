"""Invitations: sharing by link, and transfers, which somebody else must accept. Each is a secret of 256 random bits.

Only its hash is stored, as the row's key. Of several who bring it one gets each use: whoever writes the row by its
ETag. It counts only as long as what it offers belongs to whom it belonged to when it was made.
"""

import contextlib
import hashlib
from dataclasses import dataclass
from typing import Final

from function_app.domain.audit.hash_chain import Deed
from function_app.domain.common.ids import ID, new_id
from function_app.domain.common.problems import Problem, forbidden, not_found
from function_app.domain.devices import invitations as rules
from function_app.domain.devices.access import split_target
from function_app.domain.devices.devices import Agent
from function_app.domain.devices.invitations import Invitation
from function_app.domain.identity.accounts import Account, Identity, Role
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.identity.authenticator import new_secret
from function_app.services.identity.sign_in import SignIn
from function_app.services.sharing.ownership_transfer import Transfer, void
from function_app.services.sharing.shares import Shared, Sharing, require_person, yours
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import Retention

LOOK_MS: Final = 10_000
"""The timer goes on with a transfer that was accepted so long ago and is not done."""
_NOTE: Final = "transfer:"
_INDEX: Final = "invitation:"


@dataclass(frozen=True, slots=True)
class Offer:
    """What is offered.

    Attributes:
        role: ``owner``: it is transferred.
        uses: How many may redeem it.
        for_s: How long it can be redeemed [s].
        share_s: How long a part lasts from then on [s]; 0: until it is ended.
        account: Who alone may redeem it, by id; empty: whoever has the secret.
    """

    role: Role
    uses: int
    for_s: int
    share_s: int = 0
    account: str = ""


@dataclass(frozen=True, slots=True)
class Known:
    """An invitation and its id."""

    id: str
    invitation: Invitation


class Invitations:
    """Makes invitations, and has them redeemed."""

    def __init__(
        self,
        *,
        tables: Tables,
        sharing: Sharing,
        transfer: Transfer,
        sign_in: SignIn,
        pending: Reminders,
        forget: Retention,
        chain: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._sharing = sharing
        self._transfer = transfer
        self._sign_in = sign_in
        self._pending = pending
        self._forget = forget
        self._chain = chain
        self._clock = clock

    # ------------------------------------------------------------ the owner's side

    async def agent(self, who: Identity, agent_id: str) -> Shared:
        """An agent of the caller's own, to hand it over.

        Raises:
            Problem: ``agent-unknown``, ``forbidden``.
        """
        row = await self._tables.get(records.AGENTS, agent_id, "agent")
        agent = records.read(row, Agent) if row else None
        if agent is None or agent.account != who.account:
            raise not_found("agent", agent_id)
        require_person(who)
        owner = Account(who.account, await self._sign_in.named(who.account))
        return Shared(f"agent:{agent_id}", owner, agent.name, agent.pairing)

    async def space(self, who: Identity, space: str) -> Shared:
        """A space of the caller's own, to hand it over.

        Raises:
            Problem: ``space-unknown``, ``forbidden``, ``last-space``.
        """
        shared = await self._sharing.of(who, "space", space)
        require_person(who)
        if len(await self._sign_in.spaces(who.account)) == 1:
            raise _last_space("It is this account's only space. Make another one first.")
        return shared

    async def make(self, who: Identity, shared: Shared, offer: Offer) -> tuple[str, Known]:
        """A new invitation, and its secret, which nobody can be told again.

        Raises:
            Problem: ``already-yours``, ``too-many-invitations``.
        """
        if offer.role is Role.OWNER and offer.account == shared.owner.id:
            raise yours("It belongs to this account already. Name another one, or none for whoever has the link.")
        if len(await self.open(shared)) >= rules.MOST:
            detail = f"There are {rules.MOST} open invitations to it, the most there can be. Take one back."
            raise Problem("too-many-invitations", 409, "Too many invitations", detail)
        now_ms = self._clock.now_ms()
        fresh = Invitation(
            on=shared.on,
            role=offer.role,
            owner=shared.owner.id,
            by=who.name,
            label=shared.label,
            uses=offer.uses,
            created_ms=now_ms,
            expires_ms=now_ms + offer.for_s * 1000,
            share_s=offer.share_s,
            pairing=shared.pairing,
            account=offer.account,
        )
        secret = new_secret()
        known = Known(_hash(secret), fresh)
        # Forgotten on time whatever happens from here on, and listed before it can be redeemed.
        await self._forget.row(records.INVITATIONS, known.id[0], known.id, due_ms=fresh.expires_ms)
        await self._forget.row(records.SHARES, fresh.on, _INDEX + known.id, due_ms=fresh.expires_ms)
        await self._tables.create(records.SHARES, Row(fresh.on, _INDEX + known.id, {"expires_ms": fresh.expires_ms}))
        terms = {"invitation": known.id[:12], "role": offer.role.value, "uses": offer.uses, "for": offer.account}
        async with self._chain.change(fresh.owner, Deed.INVITED, who, on=fresh.on, **terms) as change:
            await change.noted()
            await self._tables.create(records.INVITATIONS, Row(known.id[0], known.id, records.fields(fresh)))
        return secret, known

    async def open(self, shared: Shared) -> list[Known]:
        """Open invitations to something, oldest first."""
        page = await self._tables.query(records.SHARES, shared.on, first=_INDEX, last="invitation;", limit=1000)
        found = [await self._get(row.key.removeprefix(_INDEX)) for row in page.rows]
        now_ms = self._clock.now_ms()
        known = [
            Known(row.key, invitation)
            for row, invitation in found
            if row is not None
            and invitation is not None
            and invitation.open(now_ms)
            and (invitation.owner, invitation.pairing) == (shared.owner.id, shared.pairing)
        ]
        return sorted(known, key=lambda each: each.invitation.created_ms)

    async def withdraw(self, who: Identity, shared: Shared, invitation: str) -> None:
        """Take an invitation back. What was redeemed stays shared.

        Raises:
            Problem: ``invitation-unknown``, ``busy``.
        """

        async def once() -> None:
            row, known = await self._get(invitation)
            if row is None or known is None or known.on != shared.on or not known.open(self._clock.now_ms()):
                raise not_found("invitation", invitation)
            await change.noted()
            await self._tables.delete(records.INVITATIONS, row)

        named = {"invitation": invitation[:12]}
        async with self._chain.change(shared.owner.id, Deed.INVITATION_REVOKED, who, on=shared.on, **named) as change:
            await records.retry(once)
        await self._unlist(shared.on, invitation)

    # ------------------------------------------------------------ the other side

    async def look(self, secret: str) -> Known:
        """What an invitation offers.

        Raises:
            Problem: ``invitation-unknown``: wrong, used, expired, taken back or void, all the same.
        """
        return await self.find(_hash(secret))

    async def find(self, invitation: str) -> Known:
        """The same by the id, for whoever has shown the secret before.

        Raises:
            Problem: ``invitation-unknown``.
        """
        row, known = await self._get(invitation)
        if row is None or known is None or not known.open(self._clock.now_ms()) or not await self._good(known):
            raise _unknown()
        return Known(row.key, known)

    async def redeem(self, who: Identity, known: Known, *, space: str | None = None) -> None:
        """Take what an invitation offers.

        Args:
            who: Who takes it.
            known: The invitation, which they have shown the secret of.
            space: The space of theirs for an agent that is handed over; ``None``: their first.

        Raises:
            Problem: ``invitation-unknown``; ``forbidden``: it is for another account, or an API key asks;
                ``already-yours``, ``last-space``, ``space-unknown``, ``too-many-shares``, ``transfer-void``, ``busy``.
        """
        require_person(who)
        offered = known.invitation
        if offered.account and offered.account != who.account:
            raise forbidden("This invitation is for another account. Sign in as the one it was made for.")
        if offered.owner == who.account:
            raise yours("It belongs to this account: there is nothing to take. Send the link to somebody else.")
        if offered.role is Role.OWNER:
            await self._take(who, known, space)
        else:
            await self._use(who, known)
            owner = Account(offered.owner, offered.by)
            shared = Shared(offered.on, owner, offered.label, offered.pairing)
            giver = Identity(offered.owner, offered.by, "")
            ends_ms = offered.ends_ms(self._clock.now_ms())
            await self._sharing.give(giver, shared, Account(who.account, who.name), offered.role, ends_ms)

    async def go_on(self, what: str, note: Row) -> None:
        """The timer's look at a transfer that was accepted."""
        row, known = await self._get(what.removeprefix(_NOTE))
        if row is not None and known is not None and known.taken_by:
            with contextlib.suppress(_Void):
                await self._carry_out(row.key, known)
        await self._pending.drop(note)

    async def _take(self, who: Identity, known: Known, space: str | None) -> None:
        """Accept a transfer. The write on the invitation decides; from then on the timer sees to it as well."""
        kind, _ = split_target(known.invitation.on)
        goal = new_id(12)
        if kind == "agent":
            own = await self._sign_in.spaces(who.account)
            chosen = next((each.id for each in own if space in {None, each.id}), None)
            if chosen is None:
                raise not_found("space", space or "")
            goal = chosen
        elif len(await self._sign_in.spaces(known.invitation.owner)) == 1:
            # It was not when it was offered: another one was handed over since.
            raise _last_space(f"It is {known.invitation.by}'s only space by now. Ask them to make another one first.")
        note = await self._pending.note(f"{_NOTE}{known.id}", self._clock.now_ms() + LOOK_MS)

        async def once() -> Invitation:
            row, fresh = await self._get(known.id)
            if row is None or fresh is None or not fresh.open(self._clock.now_ms()):
                raise _unknown()
            taken = fresh.taken(who.account, goal)
            await given.noted()
            await got.noted()
            await self._tables.replace(
                records.INVITATIONS, Row(row.partition, row.key, records.fields(taken), row.etag)
            )
            return taken

        owner, on, to = known.invitation.owner, known.invitation.on, {"to": who.account}
        async with (
            self._chain.change(owner, Deed.TRANSFERRED, who, on=on, **to) as given,
            self._chain.change(who.account, Deed.TRANSFERRED, who, on=on, **to) as got,
        ):
            taken = await records.retry(once)
        try:
            await self._carry_out(known.id, taken)
        except _Void as nothing:
            raise void() from nothing
        if note is not None:
            await self._pending.drop(note)

    async def _carry_out(self, invitation: str, taken: Invitation) -> None:
        try:
            await self._transfer.carry_out(taken)
        except Problem as problem:
            if problem.code != "transfer-void":
                raise
            await self._delete(invitation, taken)
            raise _Void from problem
        await self._delete(invitation, taken)

    async def _use(self, who: Identity, known: Known) -> None:
        """Count one use, or find that somebody else was faster."""

        async def once() -> None:
            row, fresh = await self._get(known.id)
            if row is None or fresh is None or not fresh.open(self._clock.now_ms()) or who.account in fresh.takers:
                raise _unknown()
            left = fresh.used(who.account)
            await change.noted()
            if left.uses:
                await self._tables.replace(
                    records.INVITATIONS, Row(row.partition, row.key, records.fields(left), row.etag)
                )
            else:
                await self._tables.delete(records.INVITATIONS, row)
                await self._unlist(left.on, known.id)

        owner, on, terms = known.invitation.owner, known.invitation.on, {"invitation": known.id[:12]}
        async with self._chain.change(owner, Deed.INVITATION_REDEEMED, who, on=on, **terms) as change:
            await records.retry(once)

    async def _good(self, known: Invitation) -> bool:
        """Whether what it offers is still the offerer's."""
        kind, name = split_target(known.on)
        if kind == "space":
            return await self._tables.get(records.ACCOUNTS, known.owner, f"space:{name}") is not None
        row = await self._tables.get(records.AGENTS, name.partition("-")[0], "agent")
        agent = records.read(row, Agent) if row else None
        return agent is not None and (agent.account, agent.pairing) == (known.owner, known.pairing)

    async def _get(self, invitation: str) -> tuple[Row | None, Invitation | None]:
        if not ID.match(invitation):
            return None, None
        row = await self._tables.get(records.INVITATIONS, invitation[0], invitation)
        return row, records.read(row, Invitation) if row else None

    async def _delete(self, invitation: str, known: Invitation) -> None:
        row, _ = await self._get(invitation)
        if row is not None:
            with contextlib.suppress(Conflict):
                await self._tables.delete(records.INVITATIONS, row)
        await self._unlist(known.on, invitation)

    async def _unlist(self, on: str, invitation: str) -> None:
        row = await self._tables.get(records.SHARES, on, _INDEX + invitation)
        if row is not None:
            with contextlib.suppress(Conflict):
                await self._tables.delete(records.SHARES, row)


class _Void(Exception):  # noqa: N818 (an outcome)
    """What was offered has gone elsewhere."""


def about_transfer(note: str) -> bool:
    """Whether a note of the timer is about a transfer."""
    return note.startswith(_NOTE)


def _last_space(detail: str) -> Problem:
    return Problem("last-space", 409, "The last space", detail)


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _unknown() -> Problem:
    detail = "This invitation is wrong, used, expired or taken back. Ask for a new one."
    return Problem("invitation-unknown", 404, "No such invitation", detail)
