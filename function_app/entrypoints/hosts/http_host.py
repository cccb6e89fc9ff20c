"""Validation of the ``Host`` header: a page of another site must not reach the API under its own name."""

import ipaddress
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.framework.responses import problem

ALL_ADDRESSES = "*"
"""Name that stands for every IP address, but for no other name."""


class AllowedHosts:
    """Middleware that rejects requests with a ``Host`` other than ``names``.

    A browser always sends the header. Health checks over HTTP/1.0 may omit it.
    """

    def __init__(self, app: ASGIApp, *, names: frozenset[str]) -> None:
        self._app = app
        self._names = names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See the ASGI specification."""
        if scope["type"] == "http":
            host = Headers(scope=scope).get("host")
            if host is not None and not self._accepts(host):
                detail = (
                    f"This server is not reachable as '{host[:80]}'. Use the address in TELESCOPE_PUBLIC_URL, or add "
                    "the name to TELESCOPE_ALLOWED_HOSTS."
                )
                await problem(Problem("host", 400, "Unknown host", detail))(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _accepts(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
            if name in self._names:
                return True
            return ALL_ADDRESSES in self._names and bool(ipaddress.ip_address(name))
        except ValueError:
            return False
