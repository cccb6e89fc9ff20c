"""The HTTP application: API routes, error responses, security headers, and the console."""

import asyncio
import logging
import re
import secrets
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any
from urllib.parse import urlsplit

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from device_agent.protocol.security import log_output
from function_app import VERSION
from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem, invalid, store_unavailable
from function_app.entrypoints.http.accounts import api_keys, audit, auth, me, oidc, second_factor
from function_app.entrypoints.http.actions import actions, many, stop
from function_app.entrypoints.http.autonomy import autonomy, session_recordings, tasks
from function_app.entrypoints.http.console import Console
from function_app.entrypoints.http.control import lease, mqtt_credentials
from function_app.entrypoints.http.devices import camera_consent, devices
from function_app.entrypoints.http.framework.api_reference import reference
from function_app.entrypoints.http.framework.authentication import COOKIE, RequestAuthenticator, is_stop
from function_app.entrypoints.http.framework.client_address import client_address
from function_app.entrypoints.http.framework.request_tracing import TRACE_ID, TracedRequests
from function_app.entrypoints.http.framework.responses import JSON, problem
from function_app.entrypoints.http.framework.route_index import RouteIndex
from function_app.entrypoints.http.framework.routing import (
    ACCOUNT_SCHEMES,
    AGENT_SCHEME,
    KEY_SCHEME,
    PREFIX,
    Routes,
    schemas,
)
from function_app.entrypoints.http.health import administration, diagnostics, faults, health_check, metrics
from function_app.entrypoints.http.messaging import polling, xmpp
from function_app.entrypoints.http.pairing import agents
from function_app.entrypoints.http.robot_types import (
    agent_packages,
    device_library,
    movements,
    previews,
    robot_types,
    script_editor,
)
from function_app.entrypoints.http.sharing import routes as sharing
from function_app.entrypoints.http.telemetry import blob_transfers, events, latency, recordings, series, uploads
from function_app.ports.clock import Clock
from function_app.ports.monitoring import Histogram, Metrics
from function_app.ports.tables import StoreError, StoreFullError
from function_app.services.identity.rate_limiter import RateLimiter

_SECURE_FOR = b"max-age=31536000"
"""One year [s]: browsers that used TLS once use only TLS."""
_MODULES = (
    auth, me, second_factor, oidc, api_keys, agents, polling, audit, devices, device_library, camera_consent, sharing,
    lease, stop, actions, many, autonomy, tasks, session_recordings, recordings,
    robot_types, agent_packages, previews, movements, script_editor, mqtt_credentials, xmpp,
    latency, faults, events, diagnostics, series, uploads, health_check, administration,
)  # fmt: skip
"""In the order of the OpenAPI document."""
_log = logging.getLogger(__name__)
_REQUEST_ID = re.compile(rb"[A-Za-z0-9_.:-]{1,64}")
_WRONG_METHOD = 405
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE", "PATCH", "OPTIONS"})
_TITLES = {404: "Not found", _WRONG_METHOD: "Method not allowed"}


def create_app(functions: Functions) -> FastAPI:
    """The application over one set of services."""

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        # Only shortens the first request: some hosts do not run the lifespan.
        await functions.bus.start()
        watching = asyncio.create_task(functions.health.watch())
        yield
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
        await functions.close()

    app = FastAPI(
        title="Telescope",
        version=VERSION,
        description="Operate robots and the rooms around them from anywhere.",
        openapi_url=f"{PREFIX}/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
        redirect_slashes=False,
    )
    authenticator = RequestAuthenticator(
        functions.authenticator,
        functions.api_keys,
        functions.sessions,
        functions.rate_limiter,
        trusted_proxies=functions.settings.trusted_proxies,
    )
    resources: list[Routes] = [module.router(functions, authenticator) for module in _MODULES]
    routers = [*(routes.router for routes in resources), blob_transfers.router(functions.transfers)]
    index = RouteIndex(route for router in routers for route in router.routes if isinstance(route, APIRoute))
    app.router.routes.insert(0, index)
    app.state.route_index = index
    _document(app, index, [kind for routes in resources for kind in routes.kinds])
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(StoreError, _on_store)
    app.add_exception_handler(RequestValidationError, _on_validation)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_api_route(metrics.PATH, metrics.endpoint(functions), include_in_schema=False)
    # As default instead of a mount: a mount would also receive requests with a wrong method, which must return 405.
    app.router.default = Console(functions.settings.console)
    app.add_middleware(_Addresses, limits=functions.rate_limiter, proxies=functions.settings.trusted_proxies)
    app.add_middleware(
        _Headers,
        clock=functions.clock,
        metrics=functions.metrics,
        servers=(
            functions.settings.websocket_url.partition("?")[0],
            functions.settings.xmpp.websocket_url.partition("?")[0],
            functions.blobs.origin,
        ),
        secure=_requires_hsts(functions.settings.public_url),
    )
    if functions.tracing.enabled:
        app.add_middleware(TracedRequests, tracing=functions.tracing)
    return app


def _requires_hsts(url: str) -> bool:
    """Whether to send HSTS for this host. Not for ``localhost``, where other programs serve pages, too."""
    parts = urlsplit(url)
    return parts.scheme == "https" and parts.hostname != "localhost"


def _document(app: FastAPI, index: RouteIndex, kinds: Sequence[Any]) -> None:
    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(
                title=app.title, version=app.version, description=app.description, routes=index.routes
            )
            components = document.setdefault("components", {})
            # Replaces the framework's schemas: all errors are problem details.
            components["schemas"] = schemas(kinds)
            _drop_validation_errors(document)
            components["securitySchemes"] = {
                ACCOUNT_SCHEMES[0]: {"type": "http", "scheme": "bearer", "bearerFormat": "JWT"},
                ACCOUNT_SCHEMES[1]: {"type": "apiKey", "in": "cookie", "name": COOKIE},
                KEY_SCHEME: {"type": "http", "scheme": "bearer", "description": "An API key, `ts_…`."},
                AGENT_SCHEME: {"type": "http", "scheme": "bearer", "description": "A JWT signed by the agent's key."},
            }
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]

    @app.get("/api/docs", include_in_schema=False)
    async def docs() -> Response:
        return Response(reference(app.openapi()), media_type="text/html")


def _drop_validation_errors(document: dict[str, Any]) -> None:
    """Remove the 422 response that the framework adds to every route with parameters: path text is always valid."""
    for operations in document["paths"].values():
        for operation in operations.values():
            if JSON in operation["responses"].get("422", {}).get("content", {}):
                del operation["responses"]["422"]


async def _on_problem(_request: Request, error: Exception) -> Response:
    assert isinstance(error, Problem)  # noqa: S101 (registered only for this class)
    return problem(error)


async def _on_store(_request: Request, error: Exception) -> Response:
    _log.error("%s", error)
    if isinstance(error, StoreFullError):
        return problem(Problem("storage-full", 507, "The store is full", "The tables are full. Ask the administrator."))
    return problem(
        store_unavailable("The tables are unavailable. The server's log contains the reason. Try again later.")
    )


async def _on_validation(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101 (registered only for this class)
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"])
    return problem(invalid(f"{place}: {first['msg']}."))


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101 (registered only for this class)
    title = _TITLES.get(error.status_code, str(error.detail))
    detail = f"{request.method} {request.url.path[:200]}: {str(error.detail).rstrip('.')}."
    response = problem(Problem("http", error.status_code, title, detail))
    for name, value in (error.headers or {}).items():
        response.headers[name] = value
    if error.status_code == _WRONG_METHOD:
        response.headers["Allow"] = ", ".join(_methods(request))
    return response


def _methods(request: Request) -> list[str]:
    """Methods of the path. The framework lists those of one route only."""
    index: RouteIndex = request.app.state.route_index
    routes = index.on_path(request.scope)
    return sorted({method for route in routes if route.path == routes[0].path for method in route.methods or ()})


class _Addresses:
    """Applies the rate limit per client address before all other processing."""

    def __init__(self, app: ASGIApp, *, limits: RateLimiter, proxies: int) -> None:
        self._app = app
        self._limits = limits
        self._proxies = proxies

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["path"].startswith("/api/"):
            request = Request(scope)
            address = "" if is_stop(request) else client_address(request, self._proxies)
            try:
                if address:
                    self._limits.admit("address", address)
            except Problem as rejection:
                await problem(rejection)(scope, receive, send)
                return
        await self._app(scope, receive, send)


class _Headers:
    """Adds headers to every response, and returns a 500 response for unhandled errors. Plain ASGI, for speed."""

    def __init__(self, app: ASGIApp, *, clock: Clock, metrics: Metrics, servers: tuple[str, ...], secure: bool) -> None:
        """``servers``: to which the console connects, besides this one."""
        self._app = app
        self._clock = clock
        self._metrics = metrics
        connected = " ".join(("'self'", *filter(None, servers)))
        policy = (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; font-src 'self'; "
            f"connect-src {connected}; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'"
        )
        self._fixed = [
            (b"content-security-policy", policy.encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"referrer-policy", b"no-referrer"),
            (b"x-frame-options", b"DENY"),
            (b"cross-origin-opener-policy", b"same-origin"),
            (b"cross-origin-resource-policy", b"same-origin"),
            (b"permissions-policy", b"camera=(), microphone=(), geolocation=()"),
            *([(b"strict-transport-security", _SECURE_FOR)] if secure else []),
        ]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id = _request_id(scope)
        log_output.context.set(lambda: _log_context(scope, request_id.decode()))
        started = False
        started_s = time.perf_counter()

        async def sending(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                route, method = scope.get("route"), scope["method"]
                self._metrics.observe(
                    Histogram.HTTP,
                    time.perf_counter() - started_s,
                    method if method in _METHODS else "other",
                    "console" if route is None else route.path,
                    str(message["status"]),
                )
                now = str(self._clock.now_ms()).encode()
                own = ((b"x-telescope-time-ms", now), (b"x-request-id", request_id))
                message["headers"] = [*message["headers"], *self._fixed, *own]
            await send(message)

        try:
            await self._app(scope, receive, sending)
        except ClientDisconnect:
            return  # the client disconnected during the request
        except Exception:
            _log.exception("%s %s", scope["method"], scope["path"])
            if started:
                raise
            detail = "The server failed and logged the error. Try again."
            await problem(Problem("internal", 500, "Internal error", detail))(scope, receive, sending)


def _request_id(scope: Scope) -> bytes:
    """The request id of the client, or a new one."""
    for name, value in scope["headers"]:
        if name == b"x-request-id" and _REQUEST_ID.fullmatch(value):
            received: bytes = value
            return received
    return secrets.token_hex(8).encode()


def _log_context(scope: Scope, request_id: str) -> dict[str, str]:
    parameters = scope.get("path_params", {})
    return {
        "request": request_id,
        "device": str(parameters.get("device", "")),
        "action": str(parameters.get("action", "")),
        "trace_id": scope.get(TRACE_ID, ""),
    }
