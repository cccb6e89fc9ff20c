"""``devices/{id}/shares``, ``spaces/{id}/shares``: with whom something is shared."""

from typing import Annotated, Literal

from msgspec import Meta

from function_app.entrypoints.http.contract.auth import AccountRef
from function_app.entrypoints.http.contract.base import Answer, Moment, Name, Request

SharedRole = Literal["operator", "viewer"]
ForS = Annotated[int, Meta(ge=10, le=10 * 366 * 86_400, description="How long it lasts [s]; null: until it is ended.")]


class ShareRequest(Request, frozen=True, kw_only=True):
    """With which account (its name), as what, and for how long. Asked again, it is changed."""

    account: Name
    role: SharedRole
    expires_in_s: ForS | None = None


class ShareOut(Answer, frozen=True, kw_only=True):
    """One account's part. ``by``: who shared it."""

    account: AccountRef
    role: SharedRole
    by: str
    created_at: Moment
    expires_at: Moment | None


class ShareList(Answer, frozen=True, kw_only=True):
    """Shares, oldest first: all of them."""

    items: tuple[ShareOut, ...]
    cursor: str | None
