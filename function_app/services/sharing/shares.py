"""Shares of devices and spaces with other accounts.

A write or deletion of the share's row takes effect immediately. ``AccessRevocation`` ends leases, actions and
connections of a lost role. A reminder, written first, continues this if the process is killed.
"""

import asyncio
import logging
from dataclasses import dataclass
from typing import Final

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.problems import Problem, forbidden, invalid, not_found
from function_app.domain.common.timestamps import NEVER_MS
from function_app.domain.control.control_events import Fact
from function_app.domain.devices.access import (
    MAX_SHARES,
    Kind,
    Share,
    device_target,
    expiry_ms,
    outranks,
    require_shareable,
    space_target,
    split_target,
)
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Account, Identity, Role
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.control.control_events import ControlEvents
from function_app.services.devices.device_access import DeviceAccess, require_owner, share_key
from function_app.services.devices.spaces import Spaces
from function_app.services.identity.sign_in import SignIn
from function_app.services.sharing.access_revocation import AccessRevocation, index
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders

CHECK_MS: Final = 10_000
"""Delay after which the timer continues an interrupted change."""
RETRY_MS: Final = 1_000
"""Interval of retries while the broker is not reachable."""
_CHANGED: Final = "share-changed:"
_EXPIRES: Final = "share-expires:"

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Target:
    """A target that the caller owns and may share or transfer."""

    on: str
    owner: Account
    label: str
    pairing: str = ""


class Sharing:
    """Manages shares."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        spaces: Spaces,
        sign_in: SignIn,
        access_revocation: AccessRevocation,
        reminders: Reminders,
        control_events: ControlEvents,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._spaces = spaces
        self._sign_in = sign_in
        self._access_revocation = access_revocation
        self._reminders = reminders
        self._control_events = control_events
        self._audit_log = audit_log
        self._clock = clock

    async def of(self, caller: Identity, kind: Kind, name: str) -> Target:
        """A device, space or agent of the caller, to share or transfer it.

        Raises:
            Problem: ``device-unknown``, ``space-unknown``, ``agent-unknown``, ``forbidden``; always for an API key,
                because shares outlive keys.
        """
        if kind == "agent":
            _, agent = await records.find(self._tables, records.AGENTS, name, "agent", Agent)
            if agent is None or agent.account != caller.account:
                raise not_found("agent", name)
            require_person(caller)
            owner = Account(caller.account, await self._sign_in.named(caller.account))
            return Target(f"agent:{name}", owner, agent.name, agent.pairing)
        if kind == "space":
            view = await self._spaces.own(caller, name)
            require_person(caller)
            return Target(space_target(name), view.owner, view.space.name)
        device = await self._devices.get(caller, name)
        async with self._control_events.recording_rejections(device, caller, "share it"):
            require_owner(device)
        require_person(caller)
        owner = Account(device.owner, await self._sign_in.named(device.owner))
        return Target(device_target(name), owner, device.label, device.pairing)

    async def shares(self, shared: Target) -> list[tuple[Share, str]]:
        """Current shares of a target, with account names."""
        page = await self._tables.query(records.SHARES, shared.on, first="account:", last="account;", limit=1000)
        now_ms = self._clock.now_ms()
        result = [share for row in page.rows if _is_valid(share := records.read(row, Share), shared, now_ms)]
        names = await asyncio.gather(*(self._sign_in.named(share.account) for share in result))
        return sorted(zip(result, names, strict=True), key=lambda each: each[0].created_ms)

    async def put(
        self, caller: Identity, shared: Target, account: Account, role: Role, for_s: int | None
    ) -> tuple[Share, bool, bool]:
        """Create or change the share of an account.

        Returns:
            The share, whether it is new, and whether broker and devices were notified of removed permissions. If not,
            the timer retries.

        Raises:
            Problem: ``invalid``, ``too-many-shares``, ``busy``.
        """
        expires_ms = expiry_ms(for_s, self._clock.now_ms())
        share = self._share(shared, account.id, require_shareable(role), caller.name, expires_ms)
        return await self._write(caller, shared, account, share, extend_only=False)

    async def give(self, caller: Identity, shared: Target, account: Account, role: Role, expires_ms: int) -> Share:
        """Create or extend a share by invitation; never reduces an existing one."""
        share = self._share(shared, account.id, role, caller.name, expires_ms)
        return (await self._write(caller, shared, account, share, extend_only=True))[0]

    async def end(self, caller: Identity, shared: Target, account: str) -> bool:
        """End a share; return whether broker and devices were notified. If not, the timer retries.

        Raises:
            Problem: ``share-unknown``, ``busy``.
        """
        row = await self._tables.get(records.SHARES, shared.on, share_key(account))
        if row is None or not _is_valid(records.read(row, Share), shared, self._clock.now_ms()):
            raise not_found("share", account)
        return await self._end(caller, row)

    async def end_all(self, on: str) -> None:
        """End all shares of a transferred target.

        Raises:
            Problem: ``busy``.
        """
        page = await self._tables.query(records.SHARES, on, first="account:", last="account;", limit=1000)
        for row in page.rows:
            await self._end(None, row)

    async def leave(self, caller: Identity, on: str) -> bool:
        """End the caller's own share; return whether broker and devices were notified.

        Raises:
            Problem: ``share-unknown``, ``already-owner``, ``forbidden``, ``busy``.
        """
        require_person(caller)
        row = await self._tables.get(records.SHARES, on, share_key(caller.account))
        if row is None and await self._owns(caller, on):
            raise own_share_error("This account is the owner and has no share. Transfer or unpair it instead.")
        if row is None:
            raise not_found("share", caller.account)
        return await self._end(caller, row)

    async def person(self, name: str) -> Account:
        """The account with this name.

        Raises:
            Problem: ``account-unknown``.
        """
        result = await self._sign_in.known(name)
        if result is None:
            detail = f"There is no account '{name[:80]}'. Check the exact sign-in name, or create an invitation."
            raise Problem("account-unknown", 404, "No such account", detail)
        return result

    async def _owns(self, caller: Identity, on: str) -> bool:
        kind, name = split_target(on)
        if kind == "space":
            return name in {space.id for space in await self._sign_in.spaces(caller.account)}
        device, _ = await self._devices.find_with_link(caller, name)
        return device is not None and device.owner == caller.account

    def _share(self, shared: Target, account: str, role: Role, by: str, expires_ms: int) -> Share:
        if account == shared.owner.id:
            raise invalid("This account is the owner and cannot get a share. Transfer it instead.")
        return Share(
            on=shared.on,
            account=account,
            role=role,
            owner=shared.owner.id,
            by=by,
            created_ms=self._clock.now_ms(),
            expires_ms=expires_ms,
            pairing=shared.pairing,
        )

    async def _write(
        self, caller: Identity, shared: Target, account: Account, share: Share, *, extend_only: bool
    ) -> tuple[Share, bool, bool]:
        reminder = await self._reminders.schedule(_reminder(_CHANGED, share), self._clock.now_ms() + CHECK_MS)
        if share.expires_ms < NEVER_MS:
            await self._reminders.schedule(_reminder(_EXPIRES, share), share.expires_ms)
        # Written first: without the share's row the index entry has no effect.
        await index(self._tables, share)
        reduced = False

        async def attempt() -> tuple[Share, bool]:
            nonlocal reduced
            row, existing = await records.find(self._tables, records.SHARES, share.on, share_key(share.account), Share)
            before = existing if existing is not None and _is_valid(existing, shared, self._clock.now_ms()) else None
            if before is not None and extend_only and not _extends(share, before):
                return before, False
            reduced = before is not None and (outranks(before.role, share.role) or share.expires_ms < before.expires_ms)
            if row is None:
                await self._check_room(share.on)
            await change.store_pending()
            if row is None:
                await self._tables.create(
                    records.SHARES, Row(share.on, share_key(share.account), records.to_data(share))
                )
            else:
                await records.update(self._tables, records.SHARES, row, share)
            return share, before is None

        terms = {"with": account.id, "name": account.name, "role": share.role.value, "expires_ms": share.expires_ms}
        async with self._audit_log.change(share.owner, AccountEvent.SHARED, caller, on=share.on, **terms) as change:
            written, created = await records.retry(attempt)
        if written is share:
            message = f"{caller.name} shared it with {account.name} as {share.role}."
            await self._add_event(
                share, Fact.SHARED, message, by=caller.name, account=account.id, role=share.role.value
            )
        return written, created, not reduced or await self._settle(share, reminder)

    async def _check_room(self, on: str) -> None:
        page = await self._tables.query(records.SHARES, on, first="account:", last="account;", limit=MAX_SHARES)
        now_ms = self._clock.now_ms()
        expired = [row for row in page.rows if not records.read(row, Share).is_live(now_ms)]
        if len(page.rows) - len(expired) >= MAX_SHARES:
            detail = f"It is already shared with {MAX_SHARES} accounts. End one of these shares."
            raise Problem("too-many-shares", 409, "Too many shares", detail)

    async def _end(self, caller: Identity | None, row: Row) -> bool:
        """Delete the share's row and revoke the permissions; return whether broker and devices were notified."""
        share = records.read(row, Share)
        reminder = await self._reminders.schedule(_reminder(_CHANGED, share), self._clock.now_ms() + CHECK_MS)
        name = await self._sign_in.named(share.account)
        on = {"on": share.on, "with": share.account, "name": name}
        async with self._audit_log.change(share.owner, AccountEvent.UNSHARED, caller, **on) as change:
            await change.store_pending()
            try:
                await self._tables.delete(records.SHARES, row)
            except Conflict:
                change.discarded = True
        if change.discarded:
            created = await self._tables.get(records.SHARES, row.partition, row.key)
            # A share that expired and was renewed concurrently remains.
            if created is not None and (
                caller is not None or not records.read(created, Share).is_live(self._clock.now_ms())
            ):
                return await self._end(caller, created)
            return True
        done = await self._settle(share, reminder)
        if caller is None:
            await self._add_event(share, Fact.UNSHARED, f"The share of {name} expired.", account=share.account)
        else:
            message = f"{caller.name} ended the share of {name}."
            await self._add_event(share, Fact.UNSHARED, message, by=caller.name, account=share.account)
        return done

    async def _settle(self, share: Share, reminder: Row | None) -> bool:
        """Revoke what exceeds the remaining role; the timer retries failed notifications."""
        done = await self._access_revocation.settle(share)
        if not done:
            await self._reminders.schedule(_reminder(_CHANGED, share), self._clock.now_ms() + RETRY_MS)
        if reminder is not None:
            await self._reminders.cancel(reminder)
        return done

    async def _add_event(self, share: Share, fact: Fact, message: str, **data: str) -> None:
        kind, name = split_target(share.on)
        device = await self._devices.get_as_owner(name) if kind == "device" else None
        if device is not None and device.pairing == share.pairing:
            await self._control_events.add_event(device, fact, message, data=data)

    async def check_reminder(self, what: str, reminder: Row) -> None:
        """Called by the timer for a changed or expiring share."""
        expired = what.startswith(_EXPIRES)
        on, _, account = what.removeprefix(_EXPIRES if expired else _CHANGED).rpartition("|")
        row, share = await records.find(self._tables, records.SHARES, on, share_key(account), Share)
        if row is not None and share is not None and not share.is_live(self._clock.now_ms()):
            await self._end(None, row)
        elif not expired:
            revoked = share or Share(on, account, Role.VIEWER, "", "", 0)
            if not await self._access_revocation.settle(revoked, again=True):
                await self._reminders.schedule(what, self._clock.now_ms() + RETRY_MS)
        await self._reminders.cancel(reminder)


def require_person(caller: Identity) -> None:
    """Check that the caller is a person: API keys cannot share, transfer or accept.

    Raises:
        Problem: ``forbidden``.
    """
    if caller.key:
        raise forbidden("An API key cannot share, transfer or accept. Sign in instead.")


def own_share_error(detail: str) -> Problem:
    """The error for operations that the owner cannot apply to an own target."""
    return Problem("already-owner", 409, "Not possible for the owner", detail)


def about_share(reminder: str) -> bool:
    """Whether a reminder is about a share."""
    return reminder.startswith((_CHANGED, _EXPIRES))


def _reminder(kind: str, share: Share) -> str:
    return f"{kind}{share.on}|{share.account}"


def _is_valid(share: Share, shared: Target, now_ms: int) -> bool:
    return share.is_live(now_ms) and share.owner == shared.owner.id and share.pairing == shared.pairing


def _extends(share: Share, than: Share) -> bool:
    if share.role is than.role:
        return share.expires_ms > than.expires_ms
    return outranks(share.role, than.role)
