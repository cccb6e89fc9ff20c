"""Invitations: an offered share or transfer, which an account redeems with a secret."""

from dataclasses import dataclass, replace
from typing import Final

from function_app.domain.common.timestamps import NEVER_MS
from function_app.domain.identity.accounts import Role

MAX_INVITATIONS: Final = 20
"""Maximum number of open invitations to one target."""


@dataclass(frozen=True, slots=True)
class Invitation:
    """An offered share or transfer. The secret is not stored; the row's key is its hash.

    Attributes:
        on: ``device:<id>`` or ``space:<id>``; for the role owner also ``agent:<id>``.
        role: Role of the account that redeems it. ``owner``: a transfer.
        owner: Owner's account at creation. The invitation is void when the owner changes.
        by: Name of the account that created it.
        label: Label of the target.
        uses: Remaining uses.
        expires_ms: Expiry time [ms since 1970].
        share_s: Duration of the share [s]; 0: unlimited.
        pairing: Pairing of the agent; empty for a space.
        account: The only account that may redeem it; empty: any holder of the secret.
        takers: Accounts that have redeemed it. Each account may redeem it once, so a removed account cannot return.
        taken_by: For a transfer: the account that accepted it.
        taken_space: For a transfer: the space of that account that receives the agents.
    """

    on: str
    role: Role
    owner: str
    by: str
    label: str
    uses: int
    created_ms: int
    expires_ms: int
    share_s: int = 0
    pairing: str = ""
    account: str = ""
    takers: tuple[str, ...] = ()
    taken_by: str = ""
    taken_space: str = ""

    def is_open(self, now_ms: int) -> bool:
        """Whether it can still be redeemed."""
        return self.uses > 0 and now_ms < self.expires_ms

    def accepted(self, account: str, space: str) -> "Invitation":
        """A transfer that has been accepted, so that no other account can accept it."""
        return replace(self, uses=0, taken_by=account, taken_space=space, expires_ms=NEVER_MS)

    def redeemed(self, account: str) -> "Invitation":
        """The invitation with one use less."""
        return replace(self, uses=self.uses - 1, takers=(*self.takers, account))

    def ends_ms(self, now_ms: int) -> int:
        """Expiry time of a share that starts now [ms since 1970]."""
        return now_ms + self.share_s * 1000 if self.share_s else NEVER_MS
