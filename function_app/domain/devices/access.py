"""Permissions on a device: of its owner, and of accounts with which the device or its space is shared.

A share grants ``operator`` or ``viewer``. Ownership changes only by a transfer. A share of a device belongs to one
pairing of the agent; a share of a space belongs to the owner's account. Unpairing, moving and transferring end a share
without deleting it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

from function_app.domain.common.ids import device_id
from function_app.domain.common.problems import invalid
from function_app.domain.common.timestamps import NEVER_MS
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity, Role

Kind = Literal["device", "space", "agent"]
"""A share refers to a device or a space; a transfer refers to a space or an agent."""
MAX_SHARES: Final = 100
"""Maximum number of accounts with access to one device or space."""
_RANKS: Final = {Role.VIEWER: 0, Role.OPERATOR: 1, Role.OWNER: 2}


@dataclass(frozen=True, slots=True)
class Share:
    """The access of one account to a device or space.

    Attributes:
        on: ``device:<id>`` or ``space:<id>``.
        account: The account with access.
        role: ``operator`` or ``viewer``.
        owner: The owner's account at the time of sharing.
        by: Name of the account that shared it.
        expires_ms: Expiry time [ms since 1970].
        pairing: Pairing of the device's agent; empty for a space.
    """

    on: str
    account: str
    role: Role
    owner: str
    by: str
    created_ms: int
    expires_ms: int = NEVER_MS
    pairing: str = ""

    def is_live(self, now_ms: int) -> bool:
        """Whether the share has not expired."""
        return now_ms < self.expires_ms

    def applies_to(self, agent: Agent, now_ms: int) -> bool:
        """Whether the share is live and the agent has not changed owner, space or pairing."""
        if not self.is_live(now_ms) or self.owner != agent.account:
            return False
        return self.on == space_target(agent.space or "") or (bool(self.pairing) and self.pairing == agent.pairing)


@dataclass(frozen=True, slots=True)
class Permissions:
    """What an account may do with a device.

    Attributes:
        role: The highest role.
        until_ms: When the role changes, or the caller's session ends [ms since 1970].
        space: Role in the whole space; ``None`` for access to this device only.
    """

    role: Role
    until_ms: int = NEVER_MS
    space: Role | None = None


OWNER_PERMISSIONS: Final = Permissions(Role.OWNER, space=Role.OWNER)


def permissions(caller: Identity, agent: Agent, name: str, shares: Iterable[Share], now_ms: int) -> Permissions | None:
    """The permissions of ``caller`` on a device; ``None``: the device is not visible to the caller.

    ``shares`` are the caller's shares of this device and its space. An API key limits role and devices.
    """
    if agent.account is None:
        return None
    if agent.account == caller.account and not caller.only and caller.most is Role.OWNER:
        return Permissions(Role.OWNER, caller.until_ms, Role.OWNER)
    device, space = device_target(device_id(agent.id, name)), space_target(agent.space or "")
    if agent.account == caller.account:
        result: Permissions | None = OWNER_PERMISSIONS
    else:
        live = [
            share
            for share in shares
            if share.account == caller.account and share.on in {device, space} and share.applies_to(agent, now_ms)
        ]
        best = max(live, key=lambda share: (_RANKS[share.role], share.expires_ms), default=None)
        whole = next((share for share in live if share.on == space), None)
        result = Permissions(best.role, best.expires_ms, whole.role if whole else None) if best else None
    return None if result is None else _capped(caller, result, device_id(agent.id, name), space)


def capped(caller: Identity, role: Role) -> Role:
    """The role, limited to the highest role of ``caller``."""
    return min(role, caller.most, key=_RANKS.__getitem__)


def outranks(one: Role, other: Role) -> bool:
    """Whether ``one`` has more permissions than ``other``."""
    return _RANKS[one] > _RANKS[other]


def device_target(device: str) -> str:
    """The target of a share of a device."""
    return f"device:{device}"


def space_target(space: str) -> str:
    """The target of a share of a space; also used in ``Identity.only``."""
    return f"space:{space}"


def split_target(on: str) -> tuple[str, str]:
    """Kind and id of a target."""
    kind, _, name = on.partition(":")
    return kind, name


def expiry_ms(for_s: int | None, now_ms: int) -> int:
    """Expiry time of a duration that starts now [s]; ``None``: does not expire."""
    return NEVER_MS if for_s is None else now_ms + for_s * 1000


def require_shareable(role: Role) -> Role:
    """The role, if it can be shared. Raises ``invalid``."""
    if role is Role.OWNER:
        raise invalid("A role is operator or viewer. To change the owner, transfer the agent or the space.")
    return role


def _capped(caller: Identity, result: Permissions, device: str, space: str) -> Permissions | None:
    whole = not caller.only or space in caller.only
    if not whole and device not in caller.only:
        return None
    in_space = capped(caller, result.space) if result.space is not None and whole else None
    return Permissions(capped(caller, result.role), min(result.until_ms, caller.until_ms), in_space)
