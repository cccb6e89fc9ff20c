"""Who calls: a bearer token, or the page's cookie."""

from fastapi import Request

from function_app.domain.accounts import Identity
from function_app.domain.devices import Agent
from function_app.domain.problems import forbidden, unauthorized
from function_app.services.identity import API, SESSION, Identify

COOKIE = "telescope_session"
CLIENT_HEADER = "X-Telescope-Client"
_READING = frozenset({"GET", "HEAD", "OPTIONS"})


class Caller:
    """Finds out who makes a request."""

    def __init__(self, identify: Identify) -> None:
        self._identify = identify

    async def account(self, request: Request) -> Identity:
        """The account that asks.

        A cookie travels with every request that a browser makes, whoever wrote the page: what changes something must
        carry a header as well that another site's page cannot send.

        Raises:
            Problem: ``unauthorized``; ``forbidden`` for a changing request by cookie without the header.
        """
        token = bearer(request)
        if token:
            return await self._identify.person(token, API)
        cookie = request.cookies.get(COOKIE)
        if not cookie:
            raise unauthorized("Give an access token (Authorization: Bearer …), or sign in.")
        who = await self._identify.person(cookie, SESSION)
        if request.method not in _READING and not request.headers.get(CLIENT_HEADER):
            raise forbidden(f"A changing request by cookie needs the header {CLIENT_HEADER}.")
        return who

    async def agent(self, request: Request) -> Agent:
        """The enrolled agent that asks.

        Raises:
            Problem: ``unauthorized``.
        """
        return await self._identify.agent(bearer(request))

    async def enrolling(self, request: Request, public_key: str) -> str:
        """The id of an agent that may be new, once its token is seen to be signed by ``public_key``.

        Raises:
            Problem: ``unauthorized``.
        """
        return await self._identify.enrolling(bearer(request), public_key)


def bearer(request: Request) -> str:
    """The bearer token, or empty."""
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""
