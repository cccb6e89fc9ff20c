"""``auth``, ``accounts``, ``spaces``."""

from typing import Annotated, Literal

from msgspec import Meta

from function_app.entrypoints.http.contract.base import Answer, Name, Request


class SignInRequest(Request, frozen=True, kw_only=True):
    """The token of a one-time link."""

    link: Annotated[str, Meta(min_length=1, max_length=200)]


class AccountRef(Answer, frozen=True, kw_only=True):
    """An account, as others see it."""

    id: str
    name: str


class SignedIn(Answer, frozen=True, kw_only=True):
    """A new sign-in session."""

    access_token: str
    token_type: Literal["Bearer"]
    expires_in_s: int
    account: AccountRef
    session: str


class Me(Answer, frozen=True, kw_only=True):
    """Who asks."""

    id: str
    name: str
    session: str


class SpaceRequest(Request, frozen=True, kw_only=True):
    """A new space."""

    name: Name


class SpaceOut(Answer, frozen=True, kw_only=True):
    """A space. ``role``: what the caller may do in it; agents can be claimed into one's own."""

    id: str
    name: str
    role: Literal["owner", "operator", "viewer"]
    owner: AccountRef


class SpaceList(Answer, frozen=True, kw_only=True):
    """Spaces."""

    items: tuple[SpaceOut, ...]
    cursor: str | None
