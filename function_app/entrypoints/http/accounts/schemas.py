"""``auth``, ``accounts``, ``spaces``."""

from typing import Annotated, Literal

from msgspec import Meta

from function_app.entrypoints.http.framework.schemas import Answer, Moment, Name, Request


class SignInRequest(Request, frozen=True, kw_only=True):
    """The token of a one-time link."""

    link: Annotated[str, Meta(min_length=1, max_length=200)]


NewPassword = Annotated[
    str, Meta(max_length=1000, description="At least 12 characters, and none that is guessed first.")
]


class PasswordSignIn(Request, frozen=True, kw_only=True):
    """A local account's name and password."""

    name: Name
    password: Annotated[str, Meta(min_length=1, max_length=1000)]


class PasswordRequest(Request, frozen=True, kw_only=True):
    """A new password."""

    password: NewPassword
    old_password: Annotated[str, Meta(max_length=1000)] | None = None


class NewAccount(Request, frozen=True, kw_only=True):
    """An account to be made. ``name`` is what its owner signs in by, and others see."""

    invitation: Annotated[str, Meta(min_length=1, max_length=200)]
    name: Annotated[str, Meta(pattern=r"^[^\s\x00-\x1f\x7f]([^\x00-\x1f\x7f]{0,58}[^\s\x00-\x1f\x7f])?$")]
    password: NewPassword


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
    csrf_token: str


class Elsewhere(Answer, frozen=True, kw_only=True):
    """A provider to sign in at: its name, and the address that leads there."""

    name: str
    address: str


class Methods(Answer, frozen=True, kw_only=True):
    """How one may sign in. ``open_id``: at an OpenID Connect provider, where there is one."""

    link: bool
    password: bool
    open_id: Elsewhere | None


class SignInElsewhere(Request, frozen=True, kw_only=True):
    """The secret of an invitation, for who was invited and has no account yet."""

    invitation: Annotated[str, Meta(min_length=1, max_length=200)]


class Begun(Answer, frozen=True, kw_only=True):
    """Where a browser goes on to sign in."""

    address: str


class AccessToken(Answer, frozen=True, kw_only=True):
    """The next access token of a session."""

    access_token: str
    token_type: Literal["Bearer"]
    expires_in_s: int


class Me(Answer, frozen=True, kw_only=True):
    """Who asks. ``csrf_token``: what a page shows with its cookie; ``null`` for who comes without one."""

    id: str
    name: str
    session: str
    csrf_token: str | None


class SessionOut(Answer, frozen=True, kw_only=True):
    """A sign-in session. ``mine``: the one that asks."""

    id: str
    how: Literal["link", "password", "open-id"]
    since: Moment
    expires_at: Moment
    address: str
    program: str
    mine: bool


class SessionList(Answer, frozen=True, kw_only=True):
    """Sign-in sessions, the newest first."""

    items: tuple[SessionOut, ...]
    cursor: str | None


class SessionsEnded(Answer, frozen=True, kw_only=True):
    """How many were ended."""

    ended: int


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
