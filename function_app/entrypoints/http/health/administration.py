"""The state of the installation, for administrators."""

import asyncio

from fastapi import Request, Response

from device_agent.protocol.security import log_output
from function_app import VERSION
from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.framework.administration import require_administrator
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.health import schemas
from function_app.entrypoints.http.health.health_check import parts_out
from function_app.services.maintenance.heartbeats import Heartbeat
from function_app.services.maintenance.readiness import Health

_MAX_ERRORS = 50


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("health")

    @routes.add("GET /administration", "Get the state of the installation", schemas.AdministrationOut)
    async def get_administration(request: Request) -> Response:
        """For administrators only. ``errors``: recent warnings and errors of this process and of the workers."""
        settings = functions.settings
        await require_administrator(request, auth, settings.administration)
        health = await functions.health.check()
        sizes = await asyncio.to_thread(functions.adapters.stored_bytes)
        body = schemas.AdministrationOut(
            status=health.status,
            version=VERSION,
            parts=parts_out(health.parts),
            workers=tuple(_worker(beat) for beat in health.workers),
            broker=schemas.BrokerOut(kind=settings.broker, address=f"{settings.mqtt_host}:{settings.mqtt_port}"),
            agents_online=max((beat.agents_online for beat in health.workers), default=0),
            devices_online=max((beat.devices_online for beat in health.workers), default=0),
            tables_bytes=sizes.get("tables"),
            blobs_bytes=sizes.get("blobs"),
            free_bytes=functions.adapters.free_bytes(),
            errors=_errors(health),
        )
        return json_response(body, headers={"Cache-Control": "no-store"})

    return routes


def _worker(beat: Heartbeat) -> schemas.WorkerOut:
    return schemas.WorkerOut(
        name=beat.name,
        host=beat.host,
        version=beat.version,
        started_at=rfc3339(beat.started_ms),
        seen_at=rfc3339(beat.seen_ms),
    )


def _errors(health: Health) -> tuple[schemas.LoggedOut, ...]:
    lines = [("server", *line) for line in log_output.recent.lines()]
    lines += [(beat.name, *line) for beat in health.workers for line in beat.errors]
    newest = sorted(lines, key=lambda line: line[1], reverse=True)[:_MAX_ERRORS]
    return tuple(
        schemas.LoggedOut(program=program, at=rfc3339(at_ms), level=level, message=message)
        for program, at_ms, level, message in newest
    )
