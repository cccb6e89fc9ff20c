"""Authentication of requests by bearer token, API key or session cookie."""

import hmac
import re

from fastapi import Request

from function_app.domain.common.problems import Problem, forbidden, unauthorized
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity
from function_app.domain.identity.api_keys import PREFIX as KEY_PREFIX
from function_app.entrypoints.http.framework.client_address import client_address
from function_app.entrypoints.http.framework.routing import takes_keys
from function_app.services.accounts.api_keys import ApiKeys
from function_app.services.identity.authenticator import API, Authenticator
from function_app.services.identity.rate_limiter import RateLimiter
from function_app.services.identity.sessions import Sessions, SignInOrigin

COOKIE = "telescope_session"
CSRF_HEADER = "X-CSRF-Token"
AUTHENTICATED = "telescope.authenticated"
"""Key of an ASGI scope whose request was authenticated."""
_STOP = re.compile(r"/api/v1/((devices|spaces)/[^/]+/)?stop")
_SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


class RequestAuthenticator:
    """Authenticates requests and applies rate limits per caller."""

    def __init__(
        self,
        authenticator: Authenticator,
        api_keys: ApiKeys,
        sessions: Sessions,
        limits: RateLimiter,
        *,
        trusted_proxies: int,
    ) -> None:
        self._authenticator = authenticator
        self._api_keys = api_keys
        self._sessions = sessions
        self._limits = limits
        self._trusted_proxies = trusted_proxies

    async def account(self, request: Request) -> Identity:
        """The account of the caller: a person or an API key.

        Raises:
            Problem: ``unauthorized``; ``csrf-token`` for a changing request with a cookie but without its CSRF token;
                ``forbidden`` for an API key in an operation that rejects API keys.
        """
        token = bearer(request)
        if token.startswith(KEY_PREFIX):
            caller = await self._api_keys.identify(token)
            if not takes_keys(request.scope.get("route")):
                raise forbidden("This operation rejects API keys. Sign in as a person.")
        elif token:
            caller = await self._authenticator.person(token, API)
        else:
            caller, _ = await self.page(request)
        request.scope[AUTHENTICATED] = True
        if not is_stop(request):
            self._limits.admit("key" if caller.key else "account", caller.key or caller.account)
            if self._sessions.use_is_due(caller):
                await self._sessions.note_use(caller, self.origin(request))
        return caller

    def origin(self, request: Request, device_token: str = "") -> SignInOrigin:
        """Client address, user agent and device token of a sign-in."""
        address = client_address(request, self._trusted_proxies)
        return SignInOrigin(address, request.headers.get("user-agent", ""), device_token)

    async def page(self, request: Request) -> tuple[Identity, str]:
        """The account of the session cookie, and the session's CSRF token.

        Browsers also send the cookie with requests of other sites' pages. A changing request must therefore contain the
        CSRF token, which only pages of this site can read (``accounts/me``).

        Raises:
            Problem: ``unauthorized``; ``csrf-token``.
        """
        cookie = request.cookies.get(COOKIE)
        if not cookie:
            raise unauthorized("Send an access token (Authorization: Bearer …), or sign in.")
        caller, csrf = await self._authenticator.page(cookie)
        if request.method not in _SAFE_METHODS:
            received = request.headers.get(CSRF_HEADER, "")
            if not csrf or not hmac.compare_digest(received.encode(), csrf.encode()):
                detail = f"A changing request with a cookie requires the CSRF token of accounts/me in {CSRF_HEADER}."
                raise Problem("csrf-token", 403, "The CSRF token is missing or invalid", detail)
        return caller, csrf

    async def agent(self, request: Request) -> Agent:
        """The enrolled agent that sent the request.

        Raises:
            Problem: ``unauthorized``.
        """
        agent = await self._authenticator.agent(bearer(request))
        request.scope[AUTHENTICATED] = True
        self._limits.admit("agent", agent.id)
        return agent

    async def enrolling(self, request: Request, public_key: str) -> str:
        """The id of a new or enrolled agent whose token was verified with ``public_key``.

        Raises:
            Problem: ``unauthorized``.
        """
        return await self._authenticator.enrolling(bearer(request), public_key)


def reject_cross_site(request: Request) -> None:
    """Reject requests from pages of other sites, so that they cannot sign a user in to another account.

    Browsers send the origin of the page (``Sec-Fetch-Site``); programs do not.

    Raises:
        Problem: ``forbidden``.
    """
    if request.headers.get("sec-fetch-site", "same-origin") not in {"same-origin", "none"}:
        raise forbidden("Sign in on a page of this server.")


def is_stop(request: Request) -> bool:
    """Whether the request is a Stop. Rate limits do not apply to it."""
    return request.method == "POST" and _STOP.fullmatch(request.url.path) is not None


def bearer(request: Request) -> str:
    """The bearer token; empty if there is none."""
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""
