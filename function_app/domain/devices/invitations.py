"""Invitations: a part in something, or the thing itself, for whoever brings the secret."""

from dataclasses import dataclass, replace
from typing import Final

from function_app.domain.common.timestamps import NEVER_MS
from function_app.domain.identity.accounts import Role

MAX_INVITATIONS: Final = 20
"""Open invitations to one thing."""


@dataclass(frozen=True, slots=True)
class Invitation:
    """What is offered. The secret itself is nowhere; the row's key is its hash.

    Attributes:
        on: ``device:<id>`` or ``space:<id>``; with the role of an owner also ``agent:<id>``.
        role: What whoever redeems it becomes. ``owner``: it is transferred, all of it.
        owner: The account that it belonged to when this was made. It counts only as long as that is so.
        by: Who made it, by name.
        label: What it is, for people.
        uses: How many may still redeem it.
        expires_ms: Until then [ms since 1970].
        share_s: How long the part lasts from then on [s]; 0: until it is ended.
        pairing: Of the agent then; empty for a space.
        account: Who alone may redeem it; empty: whoever has the secret.
        takers: Accounts that have redeemed it: each does so once, and whoever was un-shared does not come back by it.
        taken_by: Of a transfer: the account that has accepted it, from when on it is on its way,
        taken_space: and the space of theirs that agents go to.
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
        """A transfer that has been accepted: nobody else can any more."""
        return replace(self, uses=0, taken_by=account, taken_space=space, expires_ms=NEVER_MS)

    def redeemed(self, account: str) -> "Invitation":
        """With one use less."""
        return replace(self, uses=self.uses - 1, takers=(*self.takers, account))

    def ends_ms(self, now_ms: int) -> int:
        """When the part ends that is taken now [ms since 1970]."""
        return now_ms + self.share_s * 1000 if self.share_s else NEVER_MS
