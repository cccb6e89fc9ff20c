"""Requests and responses of shares, invitations and transfers."""

from typing import Annotated, Literal

from msgspec import Meta

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import AccountRef, Moment, Name, Request, Response

SharedRole = Literal["operator", "viewer"]
ForS = Annotated[int, Meta(ge=10, le=10 * 366 * 86_400, description="Duration of the share [s]; null: unlimited.")]


class ShareRequest(Request, frozen=True, kw_only=True):
    """Account name, role and duration. A repeated request changes the share."""

    account: Name
    role: SharedRole
    expires_in_s: ForS | None = None


class ShareOut(Response, frozen=True, kw_only=True):
    """A share of one account. ``created_by``: name of the sharing account."""

    account: AccountRef
    role: SharedRole
    created_by: str
    created_at: Moment
    expires_at: Moment | None


class ShareRevocation(Response, frozen=True, kw_only=True):
    """The share is removed, but connections are not closed yet. ``detail``: the reason."""

    detail: str


class ShareList(Response, frozen=True, kw_only=True):
    """All shares, oldest first."""

    items: tuple[ShareOut, ...]
    cursor: str | None


Secret = Annotated[str, Meta(min_length=1, max_length=200)]
LinkS = Annotated[int, Meta(ge=60, le=30 * 86_400, description="Validity of the invitation [s].")]
Uses = Annotated[int, Meta(ge=1, le=50, description="Number of accounts that may redeem it, each once.")]


class InvitationRequest(Request, frozen=True, kw_only=True):
    """An invitation. ``role`` and ``share_s``: role and duration of the share that it offers.

    ``account``: name of the only account that may redeem it; null: any account with the secret.
    """

    role: SharedRole
    expires_in_s: LinkS = 86_400
    uses: Uses = 1
    share_s: ForS | None = None
    account: Name | None = None


class TransferRequest(Request, frozen=True, kw_only=True):
    """A transfer. ``account``: name of the only account that may accept it; null: any account with the secret."""

    expires_in_s: LinkS = 86_400
    account: Name | None = None


class InvitationOut(Response, frozen=True, kw_only=True):
    """An open invitation. ``role`` ``owner``: a transfer. ``share_s``: duration of the share; null: unlimited.

    ``account``: the only account that may redeem it, visible to the owner; null: any account with the secret.
    ``created_by_account``: id of the account that created it.
    """

    id: str
    kind: Literal["device", "space", "agent"]
    target: str
    label: str
    role: Literal["owner", "operator", "viewer"]
    created_by: str
    created_by_account: str
    uses: int
    share_s: int | None
    expires_at: Moment
    account: AccountRef | None = None


class InvitationCreated(InvitationOut, frozen=True, kw_only=True):
    """A new invitation. ``secret`` is returned only once; ``link`` is a console link that contains it."""

    secret: str
    link: str


class InvitationList(Response, frozen=True, kw_only=True):
    """All open invitations, oldest first."""

    items: tuple[InvitationOut, ...]
    cursor: str | None


class InvitationLookupRequest(Request, frozen=True, kw_only=True):
    """The secret of an invitation."""

    secret: Secret


class RedeemRequest(Request, frozen=True, kw_only=True):
    """The secret of an invitation or transfer.

    ``space``: for the transfer of an agent, its new space; null: the account's first space.
    """

    secret: Secret
    space: Id | None = None
