"""Liveness, readiness and health of the server."""

from typing import Literal

from fastapi import Request, Response

from function_app import VERSION
from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem, store_unavailable
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.health.server_health import Part, Status
from function_app.entrypoints.http.framework.administration import Access, access_of
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.health import schemas
from function_app.services.maintenance.readiness import Health

_NO_STORE = {"Cache-Control": "no-store"}


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("health")

    async def checked(request: Request) -> tuple[Health, Access]:
        return await functions.health.check(), await access_of(request, auth, functions.settings.administration)

    @routes.add("GET /health/live", "Check that the process answers", schemas.LiveOut, caller="anonymous")
    async def live(_request: Request) -> Response:
        """Uses no store and no broker: restart the process if this fails."""
        return json_response(schemas.LiveOut(status="ok"), headers=_NO_STORE)

    @routes.add("GET /health/ready", "Check that the server can be used", schemas.ReadyOut, caller="anonymous")
    async def ready(request: Request) -> Response:
        """503 if a part has failed. Administrators and the metrics token receive the list of the parts.

        ``degraded``: robots can be operated, but a part needs attention.
        """
        health, access = await checked(request)
        parts = None if access < Access.DETAILS else parts_out(health.parts)
        if health.status is Status.FAILED:
            failed = [part for part in parts or () if part.status == Status.FAILED]
            detail = "A part of the server has failed. Administrators see which one."
            if failed:
                detail = " ".join(f"{part.name}: {part.message.rstrip('.')}." for part in failed)
            extras = {} if parts is None else {"parts": parts}
            raise Problem("not-ready", 503, "The server is not ready", detail, retry_after_s=2, extras=extras)
        return json_response(schemas.ReadyOut(status=_status(health), parts=parts), headers=_NO_STORE)

    @routes.add("GET /health", "Check the server", schemas.HealthOut, caller="anonymous")
    async def health(request: Request) -> Response:
        """503: the tables are not available. ``degraded``: another part has failed or needs attention."""
        result, access = await checked(request)

        def shown(name: str) -> str:
            text = result.text(name)
            if text == "ok" or access > Access.STATUS:
                return text
            return "failed" if result.failed(name) else "degraded"

        if result.failed("tables"):
            detail = "The tables are unavailable. The server's log contains the reason. Try again later."
            raise store_unavailable(detail if access < Access.DETAILS else result.text("tables"))
        body = schemas.HealthOut(
            status=_status(result),
            version=VERSION,
            tables=shown("tables"),
            broker=shown("broker"),
            models=shown("models"),
            parts=None if access < Access.DETAILS else parts_out(result.parts),
        )
        return json_response(body, headers=_NO_STORE)

    return routes


def _status(health: Health) -> Literal["ok", "degraded"]:
    return "ok" if health.status is Status.OK else "degraded"


def parts_out(parts: tuple[Part, ...]) -> tuple[schemas.PartOut, ...]:
    """The parts as schemas."""
    return tuple(
        schemas.PartOut(name=part.name, status=part.status, message=part.message, since=rfc3339(part.since_ms))
        for part in parts
    )
