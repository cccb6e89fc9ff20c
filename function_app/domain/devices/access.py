"""Who may do what with a device, and until when: its owner, and those with whom the device or its space is shared.

A share gives ``operator`` or ``viewer``, never ``owner``: there is one owner, and a device changes hands by a transfer
alone. A share of a device belongs to one pairing of its agent, a share of a space to the account that owns the space:
un-pairing, moving away and a new owner end it without anything being deleted.
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
"""What is shared is a device or a space; what is handed over is an agent."""
MAX_SHARES: Final = 100
"""Accounts with whom one device or space is shared."""
_RANKS: Final = {Role.VIEWER: 0, Role.OPERATOR: 1, Role.OWNER: 2}


@dataclass(frozen=True, slots=True)
class Share:
    """One account's part in something.

    Attributes:
        on: ``device:<id>`` or ``space:<id>``.
        account: With whom it is shared.
        role: ``operator`` or ``viewer``.
        owner: The account it belonged to then.
        by: Who shared it, by name.
        expires_ms: From then on it is over [ms since 1970].
        pairing: Of the device's agent then; empty for a space.
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
        """Whether its time is not over."""
        return now_ms < self.expires_ms

    def applies_to(self, agent: Agent, now_ms: int) -> bool:
        """Whether it is live, and the agent still belongs to where it was shared."""
        if not self.is_live(now_ms) or self.owner != agent.account:
            return False
        return self.on == space_target(agent.space or "") or (bool(self.pairing) and self.pairing == agent.pairing)


@dataclass(frozen=True, slots=True)
class Permissions:
    """What an account may do with a device.

    Attributes:
        role: The highest that it has.
        until_ms: When that changes by itself, or who asks is signed in no longer [ms since 1970].
        space: Its role in the whole space; ``None`` where it has a part in this device alone.
    """

    role: Role
    until_ms: int = NEVER_MS
    space: Role | None = None


OWNER_PERMISSIONS: Final = Permissions(Role.OWNER, space=Role.OWNER)


def permissions(caller: Identity, agent: Agent, name: str, shares: Iterable[Share], now_ms: int) -> Permissions | None:
    """What ``caller`` may do with a device; ``None``: there is no such device for them.

    Args:
        caller: Who asks. No role above ``who.most``, nothing outside ``who.only``.
        agent: The device's agent.
        name: The device's name there.
        shares: What is shared with the account: of this device and of its space.
        now_ms: The time.
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
    """The role, or the highest that ``caller`` may have."""
    return min(role, caller.most, key=_RANKS.__getitem__)


def outranks(one: Role, other: Role) -> bool:
    """Whether ``one`` may do more than ``other``."""
    return _RANKS[one] > _RANKS[other]


def device_target(device: str) -> str:
    """What a share of a device is on."""
    return f"device:{device}"


def space_target(space: str) -> str:
    """What a share of a space is on; also how ``Identity.only`` names it."""
    return f"space:{space}"


def split_target(on: str) -> tuple[str, str]:
    """Kind and id of what is shared."""
    kind, _, name = on.partition(":")
    return kind, name


def expiry_ms(for_s: int | None, now_ms: int) -> int:
    """The end of what begins now and lasts so long [s]; ``None``: until somebody ends it."""
    return NEVER_MS if for_s is None else now_ms + for_s * 1000


def require_shareable(role: Role) -> Role:
    """The role, once it is seen that it can be shared.

    Raises:
        Problem: ``invalid``.
    """
    if role is Role.OWNER:
        raise invalid("A role is operator or viewer. To make somebody else the owner, transfer the agent or the space.")
    return role


def _capped(caller: Identity, result: Permissions, device: str, space: str) -> Permissions | None:
    whole = not caller.only or space in caller.only
    if not whole and device not in caller.only:
        return None
    in_space = capped(caller, result.space) if result.space is not None and whole else None
    return Permissions(capped(caller, result.role), min(result.until_ms, caller.until_ms), in_space)
