"""Invitations: shares by link, and ownership transfers. Each has a secret of 256 random bits.

Only the hash of the secret is stored, as row key. Concurrent redemptions are serialized by ETag. An invitation is void
when its target changes owner.
"""

import contextlib
import hashlib
from dataclasses import dataclass
from typing import Final

from function_app.domain.audit.hash_chain import AccountEvent
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
from function_app.services.sharing.ownership_transfer import OwnershipTransfer, invalidate
from function_app.services.sharing.shares import NewShare, Sharing, own_share_error, require_person
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import Retention

LOOK_MS: Final = 10_000
"""Delay after which the timer continues an accepted transfer."""
_NOTE: Final = "transfer:"
_INDEX: Final = "invitation:"


@dataclass(frozen=True, slots=True)
class Offer:
    """A new invitation.

    Attributes:
        role: ``owner``: a transfer.
        uses: Maximum number of redemptions.
        for_s: Validity [s].
        share_s: Duration of the share [s]; 0: unlimited.
        account: Id of the only account that may redeem it; empty: any holder of the secret.
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
    """Creates and redeems invitations."""

    def __init__(
        self,
        *,
        tables: Tables,
        sharing: Sharing,
        ownership_transfer: OwnershipTransfer,
        sign_in: SignIn,
        reminders: Reminders,
        retention: Retention,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._sharing = sharing
        self._ownership_transfer = ownership_transfer
        self._sign_in = sign_in
        self._reminders = reminders
        self._retention = retention
        self._audit_log = audit_log
        self._clock = clock

    # ------------------------------------------------------------ the owner's side

    async def agent(self, caller: Identity, agent_id: str) -> NewShare:
        """An agent of the caller, for a transfer.

        Raises:
            Problem: ``agent-unknown``, ``forbidden``.
        """
        row = await self._tables.get(records.AGENTS, agent_id, "agent")
        agent = records.read(row, Agent) if row else None
        if agent is None or agent.account != caller.account:
            raise not_found("agent", agent_id)
        require_person(caller)
        owner = Account(caller.account, await self._sign_in.named(caller.account))
        return NewShare(f"agent:{agent_id}", owner, agent.name, agent.pairing)

    async def space(self, caller: Identity, space: str) -> NewShare:
        """A space of the caller, for a transfer.

        Raises:
            Problem: ``space-unknown``, ``forbidden``, ``last-space``.
        """
        shared = await self._sharing.of(caller, "space", space)
        require_person(caller)
        if len(await self._sign_in.spaces(caller.account)) == 1:
            raise _last_space("It is this account's only space. Create another one first.")
        return shared

    async def make(self, caller: Identity, shared: NewShare, offer: Offer) -> tuple[str, Known]:
        """A new invitation and its secret, which cannot be read again.

        Raises:
            Problem: ``already-owner``, ``too-many-invitations``.
        """
        if offer.role is Role.OWNER and offer.account == shared.owner.id:
            raise own_share_error(
                "This account is already the owner. Name another account, or none to allow any holder of the link."
            )
        if len(await self.open(shared)) >= rules.MAX_INVITATIONS:
            detail = f"There are already {rules.MAX_INVITATIONS} open invitations to it. Withdraw one."
            raise Problem("too-many-invitations", 409, "Too many invitations", detail)
        now_ms = self._clock.now_ms()
        created = Invitation(
            on=shared.on,
            role=offer.role,
            owner=shared.owner.id,
            by=caller.name,
            label=shared.label,
            uses=offer.uses,
            created_ms=now_ms,
            expires_ms=now_ms + offer.for_s * 1000,
            share_s=offer.share_s,
            pairing=shared.pairing,
            account=offer.account,
        )
        secret = new_secret()
        existing = Known(_hash(secret), created)
        # Deletion is scheduled and the invitation is listed before it can be redeemed.
        await self._retention.delete_row_at(records.INVITATIONS, existing.id[0], existing.id, due_ms=created.expires_ms)
        await self._retention.delete_row_at(records.SHARES, created.on, _INDEX + existing.id, due_ms=created.expires_ms)
        await self._tables.create(
            records.SHARES, Row(created.on, _INDEX + existing.id, {"expires_ms": created.expires_ms})
        )
        terms = {"invitation": existing.id[:12], "role": offer.role.value, "uses": offer.uses, "for": offer.account}
        async with self._audit_log.change(
            created.owner, AccountEvent.INVITED, caller, on=created.on, **terms
        ) as change:
            await change.noted()
            await self._tables.create(records.INVITATIONS, Row(existing.id[0], existing.id, records.to_data(created)))
        return secret, existing

    async def open(self, shared: NewShare) -> list[Known]:
        """Open invitations to a target, oldest first."""
        page = await self._tables.query(records.SHARES, shared.on, first=_INDEX, last="invitation;", limit=1000)
        result = [await self._get(row.key.removeprefix(_INDEX)) for row in page.rows]
        now_ms = self._clock.now_ms()
        existing = [
            Known(row.key, invitation)
            for row, invitation in result
            if row is not None
            and invitation is not None
            and invitation.is_open(now_ms)
            and (invitation.owner, invitation.pairing) == (shared.owner.id, shared.pairing)
        ]
        return sorted(existing, key=lambda each: each.invitation.created_ms)

    async def withdraw(self, caller: Identity, shared: NewShare, invitation: str) -> None:
        """Withdraw an invitation. Existing shares remain.

        Raises:
            Problem: ``invitation-unknown``, ``busy``.
        """

        async def attempt() -> None:
            row, existing = await self._get(invitation)
            if (
                row is None
                or existing is None
                or existing.on != shared.on
                or not existing.is_open(self._clock.now_ms())
            ):
                raise not_found("invitation", invitation)
            await change.noted()
            await self._tables.delete(records.INVITATIONS, row)

        named = {"invitation": invitation[:12]}
        async with self._audit_log.change(
            shared.owner.id, AccountEvent.INVITATION_REVOKED, caller, on=shared.on, **named
        ) as change:
            await records.retry(attempt)
        await self._unlist(shared.on, invitation)

    # ------------------------------------------------------------ the other side

    async def look(self, secret: str) -> Known:
        """The invitation with this secret.

        Raises:
            Problem: ``invitation-unknown``: wrong, used, expired, withdrawn or void.
        """
        return await self.find(_hash(secret))

    async def find(self, invitation: str) -> Known:
        """The invitation with this id, for a caller who has presented the secret before.

        Raises:
            Problem: ``invitation-unknown``.
        """
        row, existing = await self._get(invitation)
        if (
            row is None
            or existing is None
            or not existing.is_open(self._clock.now_ms())
            or not await self._good(existing)
        ):
            raise _unknown()
        return Known(row.key, existing)

    async def redeem(self, caller: Identity, existing: Known, *, space: str | None = None) -> None:
        """Redeem an invitation.

        Args:
            caller: The account that redeems it.
            existing: The invitation, whose secret the caller has presented.
            space: Space of the caller for a transferred agent; ``None``: the first one.

        Raises:
            Problem: ``invitation-unknown``; ``forbidden``: for another account, or called with an API key;
                ``already-owner``, ``last-space``, ``space-unknown``, ``too-many-shares``, ``transfer-impossible``,
                ``busy``.
        """
        require_person(caller)
        offered = existing.invitation
        if offered.account and offered.account != caller.account:
            raise forbidden("This invitation is for another account. Sign in with that account.")
        if offered.owner == caller.account:
            raise own_share_error("This account is already the owner. Send the link to another person.")
        if offered.role is Role.OWNER:
            await self._take(caller, existing, space)
        else:
            await self._use(caller, existing)
            owner = Account(offered.owner, offered.by)
            shared = NewShare(offered.on, owner, offered.label, offered.pairing)
            giver = Identity(offered.owner, offered.by, "")
            ends_ms = offered.ends_ms(self._clock.now_ms())
            await self._sharing.give(giver, shared, Account(caller.account, caller.name), offered.role, ends_ms)

    async def go_on(self, what: str, note: Row) -> None:
        """Called by the timer: continue an accepted transfer."""
        row, existing = await self._get(what.removeprefix(_NOTE))
        if row is not None and existing is not None and existing.taken_by:
            with contextlib.suppress(_Void):
                await self._carry_out(row.key, existing)
        await self._reminders.cancel(note)

    async def _take(self, caller: Identity, existing: Known, space: str | None) -> None:
        """Accept a transfer. The write on the invitation decides; then the timer also continues it."""
        kind, _ = split_target(existing.invitation.on)
        goal = new_id(12)
        if kind == "agent":
            own = await self._sign_in.spaces(caller.account)
            chosen = next((each.id for each in own if space in {None, each.id}), None)
            if chosen is None:
                raise not_found("space", space or "")
            goal = chosen
        elif len(await self._sign_in.spaces(existing.invitation.owner)) == 1:
            # Another transfer may have made it the last space.
            raise _last_space(f"It is {existing.invitation.by}'s only space. The owner must create another one first.")
        note = await self._reminders.schedule(f"{_NOTE}{existing.id}", self._clock.now_ms() + LOOK_MS)

        async def attempt() -> Invitation:
            row, created = await self._get(existing.id)
            if row is None or created is None or not created.is_open(self._clock.now_ms()):
                raise _unknown()
            taken = created.accepted(caller.account, goal)
            await given.noted()
            await got.noted()
            await self._tables.replace(
                records.INVITATIONS, Row(row.partition, row.key, records.to_data(taken), row.etag)
            )
            return taken

        owner, on, to = existing.invitation.owner, existing.invitation.on, {"to": caller.account}
        async with (
            self._audit_log.change(owner, AccountEvent.TRANSFERRED, caller, on=on, **to) as given,
            self._audit_log.change(caller.account, AccountEvent.TRANSFERRED, caller, on=on, **to) as got,
        ):
            taken = await records.retry(attempt)
        try:
            await self._carry_out(existing.id, taken)
        except _Void as nothing:
            raise invalidate() from nothing
        if note is not None:
            await self._reminders.cancel(note)

    async def _carry_out(self, invitation: str, taken: Invitation) -> None:
        try:
            await self._ownership_transfer.carry_out(taken)
        except Problem as problem:
            if problem.code != "transfer-impossible":
                raise
            await self._delete(invitation, taken)
            raise _Void from problem
        await self._delete(invitation, taken)

    async def _use(self, caller: Identity, existing: Known) -> None:
        """Count one use; fails if another account was first."""

        async def attempt() -> None:
            row, created = await self._get(existing.id)
            if (
                row is None
                or created is None
                or not created.is_open(self._clock.now_ms())
                or caller.account in created.takers
            ):
                raise _unknown()
            left = created.redeemed(caller.account)
            await change.noted()
            if left.uses:
                await self._tables.replace(
                    records.INVITATIONS, Row(row.partition, row.key, records.to_data(left), row.etag)
                )
            else:
                await self._tables.delete(records.INVITATIONS, row)
                await self._unlist(left.on, existing.id)

        owner, on, terms = existing.invitation.owner, existing.invitation.on, {"invitation": existing.id[:12]}
        async with self._audit_log.change(owner, AccountEvent.INVITATION_REDEEMED, caller, on=on, **terms) as change:
            await records.retry(attempt)

    async def _good(self, existing: Invitation) -> bool:
        """Whether the target still belongs to the inviting account."""
        kind, name = split_target(existing.on)
        if kind == "space":
            return await self._tables.get(records.ACCOUNTS, existing.owner, f"space:{name}") is not None
        row = await self._tables.get(records.AGENTS, name.partition("-")[0], "agent")
        agent = records.read(row, Agent) if row else None
        return agent is not None and (agent.account, agent.pairing) == (existing.owner, existing.pairing)

    async def _get(self, invitation: str) -> tuple[Row | None, Invitation | None]:
        if not ID.match(invitation):
            return None, None
        row = await self._tables.get(records.INVITATIONS, invitation[0], invitation)
        return row, records.read(row, Invitation) if row else None

    async def _delete(self, invitation: str, existing: Invitation) -> None:
        row, _ = await self._get(invitation)
        if row is not None:
            with contextlib.suppress(Conflict):
                await self._tables.delete(records.INVITATIONS, row)
        await self._unlist(existing.on, invitation)

    async def _unlist(self, on: str, invitation: str) -> None:
        row = await self._tables.get(records.SHARES, on, _INDEX + invitation)
        if row is not None:
            with contextlib.suppress(Conflict):
                await self._tables.delete(records.SHARES, row)


class _Void(Exception):  # noqa: N818 (an outcome)
    """The target has another owner."""


def about_transfer(note: str) -> bool:
    """Whether a reminder is about a transfer."""
    return note.startswith(_NOTE)


def _last_space(detail: str) -> Problem:
    return Problem("last-space", 409, "The last space", detail)


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _unknown() -> Problem:
    detail = "This invitation is wrong, used, expired or withdrawn. Ask for a new one."
    return Problem("invitation-unknown", 404, "No such invitation", detail)
