"""``auth``, ``accounts``, ``spaces``."""

from typing import Annotated, Literal

from msgspec import Meta

from function_app.entrypoints.http.framework.schemas import Moment, Name, Request, Response


class LinkSignInRequest(Request, frozen=True, kw_only=True):
    """The token of a one-time link."""

    link: Annotated[str, Meta(min_length=1, max_length=200)]


NewPassword = Annotated[
    str, Meta(max_length=1000, description="At least 12 characters, and none that is guessed first.")
]


class PasswordSignInRequest(Request, frozen=True, kw_only=True):
    """A local account's name and password."""

    name: Name
    password: Annotated[str, Meta(min_length=1, max_length=1000)]


class PasswordRequest(Request, frozen=True, kw_only=True):
    """A new password."""

    password: NewPassword
    old_password: Annotated[str, Meta(max_length=1000)] | None = None


class AccountRequest(Request, frozen=True, kw_only=True):
    """An account to be made. ``name`` is what its owner signs in by, and others see."""

    invitation: Annotated[str, Meta(min_length=1, max_length=200)]
    name: Annotated[str, Meta(pattern=r"^[^\s\x00-\x1f\x7f]([^\x00-\x1f\x7f]{0,58}[^\s\x00-\x1f\x7f])?$")]
    password: NewPassword


class AccountRef(Response, frozen=True, kw_only=True):
    """An account, as others see it."""

    id: str
    name: str


class SignedIn(Response, frozen=True, kw_only=True):
    """A new sign-in session."""

    access_token: str
    token_type: Literal["Bearer"]
    expires_in_s: int
    account: AccountRef
    session: str
    csrf_token: str


class OidcProviderOut(Response, frozen=True, kw_only=True):
    """A provider to sign in at: its name, and the address that leads there."""

    name: str
    url: str


class SignInMethodsOut(Response, frozen=True, kw_only=True):
    """How one may sign in. ``oidc``: at an OpenID Connect provider, where there is one."""

    link: bool
    password: bool
    oidc: OidcProviderOut | None


class OidcSignInRequest(Request, frozen=True, kw_only=True):
    """The secret of an invitation, for who was invited and has no account yet."""

    invitation: Annotated[str, Meta(min_length=1, max_length=200)]


class OidcSignInOut(Response, frozen=True, kw_only=True):
    """Where a browser goes on to sign in."""

    url: str


class AccessToken(Response, frozen=True, kw_only=True):
    """The next access token of a session."""

    access_token: str
    token_type: Literal["Bearer"]
    expires_in_s: int


class AccountOut(Response, frozen=True, kw_only=True):
    """Who asks. ``csrf_token``: what a page shows with its cookie; ``null`` for who comes without one."""

    id: str
    name: str
    session: str
    csrf_token: str | None


class SessionOut(Response, frozen=True, kw_only=True):
    """A sign-in session. ``mine``: the one that asks."""

    id: str
    method: Literal["link", "password", "oidc"]
    created_at: Moment
    expires_at: Moment
    address: str
    program: str
    mine: bool


class SessionList(Response, frozen=True, kw_only=True):
    """Sign-in sessions, the newest first."""

    items: tuple[SessionOut, ...]
    cursor: str | None


class SessionsEnded(Response, frozen=True, kw_only=True):
    """How many were ended."""

    ended: int


class SpaceRequest(Request, frozen=True, kw_only=True):
    """A new space."""

    name: Name


class SpaceOut(Response, frozen=True, kw_only=True):
    """A space. ``role``: what the caller may do in it; agents can be claimed into one's own."""

    id: str
    name: str
    role: Literal["owner", "operator", "viewer"]
    owner: AccountRef


class SpaceList(Response, frozen=True, kw_only=True):
    """Spaces."""

    items: tuple[SpaceOut, ...]
    cursor: str | None
