"""Requests and responses of accounts, sign-in, spaces, API keys and the audit log."""

from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from function_app.domain.identity.api_keys import MOST_DAYS, MOST_ONLY
from function_app.entrypoints.http.framework.schemas import AccountRef, LabelledRequest, Moment, Name, Request, Response

DeviceToken = Annotated[
    str, Meta(max_length=2000, description="From an earlier sign-in of this browser or program; optional.")
]

Code = Annotated[str, Meta(max_length=40, description="Code of the authenticator app, or a recovery code.")]
CurrentPassword = Annotated[str, Meta(max_length=1000)]


class LinkSignInRequest(Request, frozen=True, kw_only=True):
    """The secret of a one-time link. ``code``: for an account with a second factor."""

    link: Annotated[str, Meta(min_length=1, max_length=200)]
    device_token: DeviceToken = ""
    code: Code = ""


NewPassword = Annotated[
    str, Meta(max_length=1000, description="At least 12 characters; common passwords are rejected.")
]


class PasswordSignInRequest(Request, frozen=True, kw_only=True):
    """Name and password of a local account. ``code``: for an account with a second factor."""

    name: Name
    password: Annotated[str, Meta(min_length=1, max_length=1000)]
    device_token: DeviceToken = ""
    code: Code = ""


class PasswordRequest(Request, frozen=True, kw_only=True):
    """A new password."""

    password: NewPassword
    old_password: CurrentPassword | None = None


class SecondFactorRequest(Request, frozen=True, kw_only=True):
    """The current password. Not required within 10 minutes of a sign-in by one-time link."""

    password: CurrentPassword | None = None


class SecondFactorCode(Request, frozen=True, kw_only=True):
    """A code that confirms the change."""

    code: Annotated[str, Meta(min_length=1, max_length=40)]


class SecondFactorOut(Response, frozen=True, kw_only=True):
    """The second factor. ``recovery_codes``: number of unused recovery codes."""

    enabled: bool
    enabled_at: Moment | None
    recovery_codes: int


class SecondFactorSecret(Response, frozen=True, kw_only=True):
    """A new secret for an authenticator app. ``qr``: the QR code of ``otpauth_uri``; each row has ``1`` for black."""

    secret: str
    otpauth_uri: str
    qr: tuple[str, ...]


class RecoveryCodes(Response, frozen=True, kw_only=True):
    """New recovery codes; returned only once. Each replaces one code of the app."""

    recovery_codes: tuple[str, ...]


class AccountRequest(Request, frozen=True, kw_only=True):
    """A new account. ``name`` is the sign-in name. Other accounts can see it."""

    invitation: Annotated[str, Meta(min_length=1, max_length=200)]
    name: Annotated[str, Meta(pattern=r"^[^\s\x00-\x1f\x7f]([^\x00-\x1f\x7f]{0,58}[^\s\x00-\x1f\x7f])?$")]
    password: NewPassword


class SignedIn(Response, frozen=True, kw_only=True):
    """A new sign-in session.

    ``device_token``: send it with the next sign-in. It marks a known browser, which has its own limit of wrong
    passwords.
    """

    access_token: str
    token_type: Literal["Bearer"]
    expires_in_s: int
    account: AccountRef
    session: str
    csrf_token: str
    device_token: str


class OidcProviderOut(Response, frozen=True, kw_only=True):
    """An OpenID Connect provider: its name, and the URL that starts the sign-in."""

    name: str
    url: str


class SignInMethodsOut(Response, frozen=True, kw_only=True):
    """Available sign-in methods. ``oidc``: the OpenID Connect provider, if configured."""

    link: bool
    password: bool
    oidc: OidcProviderOut | None


class OidcSignInRequest(Request, frozen=True, kw_only=True):
    """The secret of an invitation, for a user without an account."""

    invitation: Annotated[str, Meta(min_length=1, max_length=200)]


class OidcSignInOut(Response, frozen=True, kw_only=True):
    """URL at which the browser continues the sign-in."""

    url: str


class AccessToken(Response, frozen=True, kw_only=True):
    """A new access token of a session."""

    access_token: str
    token_type: Literal["Bearer"]
    expires_in_s: int


class StorageOut(Response, frozen=True, kw_only=True):
    """Stored recordings, captures, movements and robot types of an account [bytes].

    ``devices``: recordings and captures by device.
    """

    used_bytes: int
    limit_bytes: int
    device_limit_bytes: int
    devices: dict[str, int]


class AccountOut(Response, frozen=True, kw_only=True):
    """The signed-in account. ``csrf_token`` is required in requests with the cookie; null for a bearer token.

    ``administrator``: may read the state of the server.
    """

    id: str
    name: str
    session: str
    csrf_token: str | None
    administrator: bool
    storage: StorageOut


class SessionOut(Response, frozen=True, kw_only=True):
    """A sign-in session. ``mine``: the session of this request.

    ``address`` and ``program`` (user agent): of the last use. ``last_used_at`` has a resolution of five minutes.
    """

    id: str
    method: Literal["link", "password", "oidc"]
    created_at: Moment
    last_used_at: Moment
    expires_at: Moment
    address: str
    program: str
    mine: bool


class SessionList(Response, frozen=True, kw_only=True):
    """Active sign-in sessions, newest first."""

    items: tuple[SessionOut, ...]
    cursor: str | None


class SignInOut(Response, frozen=True, kw_only=True):
    """A past sign-in. ``known_browser``: it had signed in before. ``mine``: it began the session of this request."""

    session: str
    method: Literal["link", "password", "oidc"]
    at: Moment
    address: str
    program: str
    known_browser: bool
    mine: bool


class SignInList(Response, frozen=True, kw_only=True):
    """The newest sign-ins of the last 30 days, at most 50, newest first."""

    items: tuple[SignInOut, ...]
    cursor: str | None


class SessionsEnded(Response, frozen=True, kw_only=True):
    """Number of ended sessions."""

    ended: int


class SpaceRequest(LabelledRequest, frozen=True, kw_only=True):
    """A new space."""

    labels: ClassVar = ("name",)
    name: Name


class SpaceOut(Response, frozen=True, kw_only=True):
    """A space. ``role``: the caller's role. Only an owner can claim agents into it."""

    id: str
    name: str
    role: Literal["owner", "operator", "viewer"]
    owner: AccountRef


class SpaceList(Response, frozen=True, kw_only=True):
    """Spaces of the account, and spaces shared with it."""

    items: tuple[SpaceOut, ...]
    cursor: str | None


Target = Annotated[str, Meta(pattern="^(space:)?[A-Za-z0-9_-]{1,64}$")]


class ApiKeyRequest(Request, frozen=True, kw_only=True):
    """A new API key. ``only``: ids of devices, and ``space:<id>``; empty: all devices that the account can access."""

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    role: Literal["operator", "viewer"]
    only: Annotated[tuple[Target, ...], Meta(max_length=MOST_ONLY)] = ()
    days: Annotated[int, Meta(ge=1, le=MOST_DAYS)] = 90


class ApiKeyOut(Response, frozen=True, kw_only=True):
    """An API key without its secret. ``last_used_at`` has a resolution of one hour."""

    id: str
    name: str
    role: str
    only: tuple[str, ...]
    created_at: Moment
    expires_at: Moment
    expired: bool
    last_used_at: Moment | None


class ApiKeyCreated(Response, frozen=True, kw_only=True):
    """A new API key. ``token`` is returned only once."""

    api_key: ApiKeyOut
    token: str


class ApiKeyList(Response, frozen=True, kw_only=True):
    """API keys, newest first."""

    items: tuple[ApiKeyOut, ...]
    cursor: str | None


class AuditRecordOut(Response, frozen=True, kw_only=True):
    """One audit record. ``hash`` covers the record and the hash of the previous record.

    ``account``, ``session`` and ``key`` (an API key) identify the actor. All are empty if the actor is the cloud or
    unknown.
    """

    seq: int
    at: Moment
    event: str
    target: str
    outcome: Literal["done", "rejected", "failed", "unknown"]
    actor: str
    account: str
    session: str
    key: str
    data: dict[str, Any]
    hash: str


class AuditList(Response, frozen=True, kw_only=True):
    """Audit records, newest first. A filtered page may be short or empty and still have a cursor."""

    items: tuple[AuditRecordOut, ...]
    cursor: str | None
