"""Who calls: a bearer token, an API key, or the page's cookie."""

import hmac
import re

from fastapi import Request

from function_app.domain.common.problems import Problem, forbidden, unauthorized
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity
from function_app.domain.identity.api_keys import PREFIX as KEY_PREFIX
from function_app.entrypoints.http.framework.routing import takes_keys
from function_app.services.accounts.api_keys import ApiKeys
from function_app.services.identity.authenticator import API, Authenticator
from function_app.services.identity.rate_limiter import RateLimiter

COOKIE = "telescope_session"
CSRF_HEADER = "X-CSRF-Token"
_STOP = re.compile(r"/api/v1/((devices|spaces)/[^/]+/)?stop")
_READING = frozenset({"GET", "HEAD", "OPTIONS"})


class RequestAuthenticator:
    """Finds out who makes a request."""

    def __init__(self, authenticator: Authenticator, api_keys: ApiKeys, limits: RateLimiter) -> None:
        self._authenticator = authenticator
        self._api_keys = api_keys
        self._limits = limits

    async def account(self, request: Request) -> Identity:
        """The account that asks, itself or by an API key.

        Raises:
            Problem: ``unauthorized``; ``csrf-token`` for a changing request by cookie without the session's token;
                ``forbidden`` for an API key, where only people may ask.
        """
        token = bearer(request)
        if token.startswith(KEY_PREFIX):
            who = await self._api_keys.identify(token)
            if not takes_keys(request.scope.get("route")):
                raise forbidden("An API key may not do this. Sign in, and do it yourself.")
        elif token:
            who = await self._authenticator.person(token, API)
        else:
            who, _ = await self.page(request)
        if not is_stop(request):
            self._limits.admit("key" if who.key else "account", who.key or who.account)
        return who

    async def page(self, request: Request) -> tuple[Identity, str]:
        """The account that asks by a page's cookie, and the session's CSRF token.

        Browsers also send the cookie with requests that pages of other sites make. A changing request must therefore
        carry the CSRF token. Only this site's page can read the token (``accounts/me``).

        Raises:
            Problem: ``unauthorized``; ``csrf-token``.
        """
        cookie = request.cookies.get(COOKIE)
        if not cookie:
            raise unauthorized("Give an access token (Authorization: Bearer …), or sign in.")
        who, csrf = await self._authenticator.page(cookie)
        if request.method not in _READING:
            shown = request.headers.get(CSRF_HEADER, "")
            if not csrf or not hmac.compare_digest(shown.encode(), csrf.encode()):
                detail = (
                    f"A changing request by cookie needs the session's token in {CSRF_HEADER}; accounts/me tells it."
                )
                raise Problem("csrf-token", 403, "The CSRF token is not this session's", detail)
        return who, csrf

    async def agent(self, request: Request) -> Agent:
        """The enrolled agent that asks.

        Raises:
            Problem: ``unauthorized``.
        """
        agent = await self._authenticator.agent(bearer(request))
        self._limits.admit("agent", agent.id)
        return agent

    async def enrolling(self, request: Request, public_key: str) -> str:
        """The id of an agent that may be new, once its token is verified with ``public_key``.

        Raises:
            Problem: ``unauthorized``.
        """
        return await self._authenticator.enrolling(bearer(request), public_key)


def refuse_other_sites(request: Request) -> None:
    """Reject requests from pages of other sites, so that they cannot sign a user in to another account.

    Browsers send the origin of the page (``Sec-Fetch-Site``); programs do not.

    Raises:
        Problem: ``forbidden``.
    """
    if request.headers.get("sec-fetch-site", "same-origin") not in {"same-origin", "none"}:
        raise forbidden("Sign in on the page of this server itself.")


def is_stop(request: Request) -> bool:
    """Whether the request orders a Stop. Rate limits do not apply to it."""
    return request.method == "POST" and _STOP.fullmatch(request.url.path) is not None


def bearer(request: Request) -> str:
    """The bearer token, or empty."""
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""
