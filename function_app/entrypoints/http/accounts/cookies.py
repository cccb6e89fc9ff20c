"""The session cookie, and the response to a sign-in."""

from fastapi import Response

from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.framework.authentication import COOKIE
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.services.identity.sessions import SignedIn
from function_app.settings import Settings


def set_session(settings: Settings, done: SignedIn) -> str:
    """``Set-Cookie`` of a new session."""
    return _session(settings, done.cookie, done.cookie_s)


def clear_session(settings: Settings) -> str:
    """``Set-Cookie`` that deletes the session cookie."""
    return _session(settings, "", 0)


def secure(settings: Settings) -> str:
    """The ``Secure`` attribute for cookies, if the console uses ``https``."""
    return "; Secure" if settings.public_url.startswith("https:") else ""


def signed_in(settings: Settings, done: SignedIn, status: int = 200) -> Response:
    """The response to a sign-in: an access token for programs, and a cookie for the page."""
    body = schemas.SignedIn(
        access_token=done.access_token,
        token_type="Bearer",  # noqa: S106 (the name of the scheme)
        expires_in_s=done.expires_in_s,
        account=AccountRef(id=done.account.id, name=done.account.name),
        session=done.session,
        csrf_token=done.csrf,
        device_token=done.device_token,
    )
    return json_response(body, status, {"Set-Cookie": set_session(settings, done), "Cache-Control": "no-store"})


def _session(settings: Settings, value: str, lifetime_s: int) -> str:
    return f"{COOKIE}={value}; Path=/api; Max-Age={lifetime_s}; HttpOnly; SameSite=Strict{secure(settings)}"
