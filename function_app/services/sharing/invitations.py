"""Invitations: shares by link, and ownership transfers. Each has a secret of 256 random bits.

Only the hash of the secret is stored, as row key. Concurrent redemptions are serialized by ETag. An invitation is void
when its target changes owner.
"""

import hashlib
from dataclasses import dataclass
from typing import Final

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.ids import ID, new_id
from function_app.domain.common.problems import Problem, forbidden, not_found
from function_app.domain.devices import invitations as rules
from function_app.domain.devices.access import Kind, split_target
from function_app.domain.devices.devices import Agent
from function_app.domain.devices.invitations import Invitation
from function_app.domain.identity.accounts import Account, Identity, Role
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.identity.authenticator import new_secret
from function_app.services.identity.sign_in import SignIn
from function_app.services.sharing.ownership_transfer import OwnershipTransfer
from function_app.services.sharing.shares import Sharing, Target, own_share_error, require_person
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import Retention

CHECK_MS: Final = 10_000
"""Delay after which the timer continues an accepted transfer."""
_REMINDER: Final = "transfer:"
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
class KnownInvitation:
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

    async def transferable(self, caller: Identity, kind: Kind, name: str) -> Target:
        """An agent or a space of the caller, for a transfer.

        Raises:
            Problem: ``agent-unknown``, ``space-unknown``, ``forbidden``, ``last-space``.
        """
        target = await self._sharing.of(caller, kind, name)
        if kind == "space" and len(await self._sign_in.spaces(caller.account)) == 1:
            raise _last_space("It is this account's only space. Create another one first.")
        return target

    async def make(self, caller: Identity, shared: Target, offer: Offer) -> tuple[str, KnownInvitation]:
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
        existing = KnownInvitation(_hash(secret), created)
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
            await change.store_pending()
            await self._tables.create(records.INVITATIONS, Row(existing.id[0], existing.id, records.to_data(created)))
        return secret, existing

    async def open(self, shared: Target) -> list[KnownInvitation]:
        """Open invitations to a target, oldest first."""
        page = await self._tables.query(records.SHARES, shared.on, first=_INDEX, last="invitation;", limit=1000)
        listed = [await self._open(row.key.removeprefix(_INDEX)) for row in page.rows]
        result = [
            KnownInvitation(row.key, invitation)
            for row, invitation in filter(None, listed)
            if (invitation.owner, invitation.pairing) == (shared.owner.id, shared.pairing)
        ]
        return sorted(result, key=lambda each: each.invitation.created_ms)

    async def withdraw(self, caller: Identity, shared: Target, invitation: str) -> None:
        """Withdraw an invitation. Existing shares remain.

        Raises:
            Problem: ``invitation-unknown``, ``busy``.
        """

        async def attempt() -> None:
            existing = await self._open(invitation)
            if existing is None or existing[1].on != shared.on:
                raise not_found("invitation", invitation)
            await change.store_pending()
            await self._tables.delete(records.INVITATIONS, existing[0])

        named = {"invitation": invitation[:12]}
        async with self._audit_log.change(
            shared.owner.id, AccountEvent.INVITATION_REVOKED, caller, on=shared.on, **named
        ) as change:
            await records.retry(attempt)
        await self._unlist(shared.on, invitation)

    async def look(self, secret: str) -> KnownInvitation:
        """The invitation with this secret.

        Raises:
            Problem: ``invitation-unknown``: wrong, used, expired, withdrawn or void.
        """
        return await self.find(_hash(secret))

    async def find(self, invitation: str) -> KnownInvitation:
        """The invitation with this id, for a caller who has presented the secret before.

        Raises:
            Problem: ``invitation-unknown``.
        """
        existing = await self._open(invitation)
        if existing is None or not await self._is_valid(existing[1]):
            raise _unknown()
        return KnownInvitation(invitation, existing[1])

    async def redeem(self, caller: Identity, existing: KnownInvitation, *, space: str | None = None) -> None:
        """Redeem an invitation, whose secret the caller has presented.

        ``space``: space of the caller for a transferred agent; ``None``: the first one.

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
            await self._accept(caller, existing, space)
        else:
            await self._use(caller, existing)
            owner = Account(offered.owner, offered.by)
            shared = Target(offered.on, owner, offered.label, offered.pairing)
            inviter = Identity(offered.owner, offered.by, "")
            ends_ms = offered.ends_ms(self._clock.now_ms())
            await self._sharing.give(inviter, shared, Account(caller.account, caller.name), offered.role, ends_ms)

    async def resume_transfer(self, what: str, reminder: Row) -> None:
        """Called by the timer: continue an accepted transfer."""
        invitation = what.removeprefix(_REMINDER)
        row, existing = await self._get(invitation)
        if row is not None and existing is not None and existing.taken_by:
            await self._carry_out(invitation, existing)
        await self._reminders.cancel(reminder)

    async def _accept(self, caller: Identity, existing: KnownInvitation, space: str | None) -> None:
        """Accept a transfer. The write on the invitation decides; then the timer also continues it."""
        kind, _ = split_target(existing.invitation.on)
        target_space = new_id(12)
        if kind == "agent":
            own = await self._sign_in.spaces(caller.account)
            own_space = next((each.id for each in own if space in {None, each.id}), None)
            if own_space is None:
                raise not_found("space", space or "")
            target_space = own_space
        elif len(await self._sign_in.spaces(existing.invitation.owner)) == 1:
            # Another transfer may have made it the last space.
            raise _last_space(f"It is {existing.invitation.by}'s only space. The owner must create another one first.")
        reminder = await self._reminders.schedule(f"{_REMINDER}{existing.id}", self._clock.now_ms() + CHECK_MS)

        async def attempt() -> Invitation:
            current = await self._open(existing.id)
            if current is None:
                raise _unknown()
            row, offered = current
            taken = offered.accepted(caller.account, target_space)
            await change.store_pending()
            await got.store_pending()
            await records.update(self._tables, records.INVITATIONS, row, taken)
            return taken

        owner, on, to = existing.invitation.owner, existing.invitation.on, {"to": caller.account}
        async with (
            self._audit_log.change(owner, AccountEvent.TRANSFERRED, caller, on=on, **to) as change,
            self._audit_log.change(caller.account, AccountEvent.TRANSFERRED, caller, on=on, **to) as got,
        ):
            taken = await records.retry(attempt)
        if not await self._carry_out(existing.id, taken):
            detail = (
                "It was transferred or unpaired after the invitation was created. Ask its owner for a new invitation."
            )
            raise Problem("transfer-impossible", 409, "It cannot be transferred", detail)
        if reminder is not None:
            await self._reminders.cancel(reminder)

    async def _carry_out(self, invitation: str, taken: Invitation) -> bool:
        """Complete an accepted transfer and delete its invitation; False: the target has another owner."""
        done = await self._ownership_transfer.carry_out(taken)
        row, _ = await self._get(invitation)
        await records.discard(self._tables, records.INVITATIONS, row)
        await self._unlist(taken.on, invitation)
        return done

    async def _use(self, caller: Identity, existing: KnownInvitation) -> None:
        """Count one use; fails if another account was first."""

        async def attempt() -> None:
            current = await self._open(existing.id)
            if current is None or caller.account in current[1].takers:
                raise _unknown()
            row, remaining = current[0], current[1].redeemed(caller.account)
            await change.store_pending()
            if remaining.uses:
                await records.update(self._tables, records.INVITATIONS, row, remaining)
            else:
                await self._tables.delete(records.INVITATIONS, row)
                await self._unlist(remaining.on, existing.id)

        owner, on, terms = existing.invitation.owner, existing.invitation.on, {"invitation": existing.id[:12]}
        async with self._audit_log.change(owner, AccountEvent.INVITATION_REDEEMED, caller, on=on, **terms) as change:
            await records.retry(attempt)

    async def _is_valid(self, existing: Invitation) -> bool:
        """Whether the target still belongs to the inviting account."""
        kind, name = split_target(existing.on)
        if kind == "space":
            return await self._tables.get(records.ACCOUNTS, existing.owner, f"space:{name}") is not None
        _, agent = await records.find(self._tables, records.AGENTS, name.partition("-")[0], "agent", Agent)
        return agent is not None and (agent.account, agent.pairing) == (existing.owner, existing.pairing)

    async def _get(self, invitation: str) -> tuple[Row | None, Invitation | None]:
        if not ID.match(invitation):
            return None, None
        row = await self._tables.get(records.INVITATIONS, invitation[0], invitation)
        return row, records.read(row, Invitation) if row else None

    async def _open(self, invitation: str) -> tuple[Row, Invitation] | None:
        row, existing = await self._get(invitation)
        if row is None or existing is None or not existing.is_open(self._clock.now_ms()):
            return None
        return row, existing

    async def _unlist(self, on: str, invitation: str) -> None:
        await records.remove(self._tables, records.SHARES, on, _INDEX + invitation)


def about_transfer(reminder: str) -> bool:
    """Whether a reminder is about a transfer."""
    return reminder.startswith(_REMINDER)


def _last_space(detail: str) -> Problem:
    return Problem("last-space", 409, "The last space", detail)


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _unknown() -> Problem:
    detail = "This invitation is wrong, used, expired or withdrawn. Ask for a new one."
    return Problem("invitation-unknown", 404, "No such invitation", detail)
