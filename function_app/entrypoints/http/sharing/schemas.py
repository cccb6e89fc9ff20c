"""Requests and responses of shares, invitations and transfers."""

from typing import Annotated, Literal

from msgspec import Meta

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import AccountRef, Moment, Name, Request, Response

SharedRole = Literal["operator", "viewer"]
ForS = Annotated[int, Meta(ge=10, le=10 * 366 * 86_400, description="How long it lasts [s]; null: until it is ended.")]


class ShareRequest(Request, frozen=True, kw_only=True):
    """Account name, role and duration. A repeated request changes the share."""

    account: Name
    role: SharedRole
    expires_in_s: ForS | None = None


class ShareOut(Response, frozen=True, kw_only=True):
    """One account's share. ``created_by``: name of the sharing account."""

    account: AccountRef
    role: SharedRole
    created_by: str
    created_at: Moment
    expires_at: Moment | None


class ShareRevocation(Response, frozen=True, kw_only=True):
    """The share has ended and control with it; ``detail``: who could not be told yet, and what becomes of that."""

    detail: str


class ShareList(Response, frozen=True, kw_only=True):
    """Shares, oldest first: all of them."""

    items: tuple[ShareOut, ...]
    cursor: str | None


Secret = Annotated[str, Meta(min_length=1, max_length=200)]
LinkS = Annotated[int, Meta(ge=60, le=30 * 86_400, description="How long it can be redeemed [s].")]
Uses = Annotated[int, Meta(ge=1, le=50, description="How many accounts may redeem it; each once.")]


class InvitationRequest(Request, frozen=True, kw_only=True):
    """Role and duration of the share that an account gets with the secret.

    ``account``: name of the only account that may redeem it; null: any account with the secret.
    """

    role: SharedRole
    expires_in_s: LinkS = 86_400
    uses: Uses = 1
    share_s: ForS | None = None
    account: Name | None = None


class TransferRequest(Request, frozen=True, kw_only=True):
    """Validity of the offer, and the only account that may accept it; null: any account with the secret."""

    expires_in_s: LinkS = 86_400
    account: Name | None = None


class InvitationOut(Response, frozen=True, kw_only=True):
    """An open invitation. ``role`` ``owner``: a transfer. ``share_s``: how long the part will last; null: no end.

    ``account``: the only account that may redeem it, visible to the owner; null: any account with the secret.
    """

    id: str
    kind: Literal["device", "space", "agent"]
    target: str
    label: str
    role: Literal["owner", "operator", "viewer"]
    created_by: str
    uses: int
    share_s: int | None
    expires_at: Moment
    account: AccountRef | None = None


class InvitationCreated(InvitationOut, frozen=True, kw_only=True):
    """An invitation with its secret, which is returned only once, and a console link that contains it."""

    secret: str
    link: str


class InvitationList(Response, frozen=True, kw_only=True):
    """Open invitations, oldest first: all of them."""

    items: tuple[InvitationOut, ...]
    cursor: str | None


class InvitationLookupRequest(Request, frozen=True, kw_only=True):
    """The secret of an invitation."""

    secret: Secret


class RedeemRequest(Request, frozen=True, kw_only=True):
    """The secret of an invitation; and for an agent that is handed over the space it shall be in (null: the first)."""

    secret: Secret
    space: Id | None = None
