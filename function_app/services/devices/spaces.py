"""Spaces that are visible to an account: owned and shared."""

import asyncio
from dataclasses import dataclass

from function_app.domain.common.problems import forbidden, not_found
from function_app.domain.devices import access
from function_app.domain.devices.access import Share, space_target
from function_app.domain.identity.accounts import Account, Identity, Role, Space
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.devices.device_access import share_key
from function_app.services.storage import records


@dataclass(frozen=True, slots=True)
class SpaceView:
    """A space with its owner and the caller's role."""

    space: Space
    role: Role
    owner: Account


class Spaces:
    """Looks up spaces. A space that is neither owned by nor shared with the account does not exist for it."""

    def __init__(self, *, tables: Tables, clock: Clock) -> None:
        self._tables = tables
        self._clock = clock

    async def list(self, caller: Identity) -> tuple[SpaceView, ...]:
        """Own spaces, oldest first, then shared ones by id."""
        owner = Account(caller.account, await self._name(caller.account))
        page = await self._tables.query(records.ACCOUNTS, caller.account, first="space:", last="space;", limit=1000)
        own = sorted((records.read(row, Space) for row in page.rows), key=lambda space: space.created_ms)
        result = [SpaceView(space, Role.OWNER, owner) for space in own]
        shared = await self._tables.query(
            records.MEMBERS, caller.account, first="share:space:", last="share:space;", limit=1000
        )
        ids = [row.key.removeprefix("share:space:") for row in shared.rows]
        result += [
            view for view in await asyncio.gather(*(self._shared(caller, name) for name in ids)) if view is not None
        ]
        return tuple(view for each in result if (view := _as_seen_by(caller, each)) is not None)

    async def get(self, caller: Identity, space: str) -> SpaceView:
        """One space. Raises ``space-unknown``."""
        row = await self._tables.get(records.ACCOUNTS, caller.account, f"space:{space}")
        view: SpaceView | None
        if row is not None:
            owner = Account(caller.account, await self._name(caller.account))
            view = SpaceView(records.read(row, Space), Role.OWNER, owner)
        else:
            view = await self._shared(caller, space)
        visible = None if view is None else _as_seen_by(caller, view)
        if visible is None:
            raise not_found("space", space)
        return visible

    async def own(self, caller: Identity, space: str) -> SpaceView:
        """One space of the account itself. Raises ``space-unknown`` or ``forbidden``."""
        view = await self.get(caller, space)
        if not view.role.may_own:
            raise forbidden("Only the owner of this space may do that.")
        return view

    async def _shared(self, caller: Identity, space: str) -> SpaceView | None:
        _, share = await records.find(
            self._tables, records.SHARES, space_target(space), share_key(caller.account), Share
        )
        if share is None or not share.is_live(self._clock.now_ms()):
            return None
        result = await self._tables.get(records.ACCOUNTS, share.owner, f"space:{space}")
        if result is None:
            return None
        return SpaceView(records.read(result, Space), share.role, Account(share.owner, await self._name(share.owner)))

    async def _name(self, account: str) -> str:
        row = await self._tables.get(records.ACCOUNTS, account, "account")
        return records.read(row, Account).name if row else ""


def _as_seen_by(caller: Identity, view: SpaceView) -> SpaceView | None:
    if caller.only and space_target(view.space.id) not in caller.only:
        return None
    return SpaceView(view.space, access.capped(caller, view.role), view.owner)
