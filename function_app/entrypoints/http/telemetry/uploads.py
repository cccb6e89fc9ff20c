"""Uploads and captures of devices."""

from typing import Any

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import not_found
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.devices import Agent, Device
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read, require_empty
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.framework.schemas import EmptyRequest, R, response_from
from function_app.entrypoints.http.telemetry import schemas
from function_app.services.devices.device_access import devices_of, require_operator, require_owner
from function_app.services.telemetry.uploads import LIFETIME_S, Announced, Capture


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("uploads")
    _for_accounts(routes, functions, auth)
    _for_agents(routes, functions, auth)
    return routes


def _for_accounts(routes: Routes, functions: Functions, auth: RequestAuthenticator) -> None:
    async def operated_device(request: Request, device: str) -> tuple[Device, str]:
        caller = await auth.account(request)
        return require_operator(await functions.devices.get(caller, device)), caller.name

    @routes.add(
        "POST /devices/{device}/uploads",
        "Start an upload",
        {201: schemas.UploadStarted},
        (404, 409, 507),
        body=schemas.UploadRequest,
    )
    async def begin_upload(request: Request, device: str) -> Response:
        """Returns a URL to which the client sends the content. The client must then complete the upload."""
        target, operator = await operated_device(request, device)
        payload: schemas.UploadRequest = await read(request, schemas.UploadRequest)
        return await _begin(functions, target, payload, f"account:{operator}")

    @routes.add(
        "POST /devices/{device}/uploads/{upload}/complete",
        "Complete an upload",
        schemas.UploadOut,
        (404, 409),
        optional_body=EmptyRequest,
    )
    async def complete_upload(request: Request, device: str, upload: str) -> Response:
        """Verifies length and hash of the content. Safe to repeat."""
        target, _ = await operated_device(request, device)
        await require_empty(request)
        return json_response(_capture_out(await functions.uploads.complete(target, upload)))

    @routes.add("GET /devices/{device}/uploads", "List captures of a device", schemas.UploadList, (404, 422))
    async def list_uploads(request: Request, device: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Returns completed captures, newest first."""
        target = await functions.devices.get(await auth.account(request), device)
        captures, next_cursor = await functions.uploads.list(target, cursor=cursor, limit=limit)
        items: tuple[schemas.UploadOut, ...] = tuple(_capture_out(capture) for capture in captures)
        return json_response(schemas.UploadList(items=items, cursor=next_cursor))

    @routes.add("GET /devices/{device}/uploads/{upload}", "Get a capture", schemas.UploadWithUrl, 404)
    async def get_upload(request: Request, device: str, upload: str) -> Response:
        """Returns a capture with a URL of its content."""
        target = await functions.devices.get(await auth.account(request), device)
        capture, url = await functions.uploads.get(target, upload)
        return json_response(
            _capture_out(capture, schemas.UploadWithUrl, url=url), headers={"Cache-Control": "no-store"}
        )

    @routes.add("DELETE /devices/{device}/uploads/{upload}", "Delete a capture", None, 404)
    async def delete_upload(request: Request, device: str, upload: str) -> Response:
        """Deletes a capture with its content. Owners only."""
        target = require_owner(await functions.devices.get(await auth.account(request), device))
        await functions.uploads.delete(target, upload)
        return empty()


def _for_agents(routes: Routes, functions: Functions, auth: RequestAuthenticator) -> None:
    @routes.add(
        "POST /agents/{agent}/uploads",
        "Start an upload of an agent",
        {201: schemas.UploadStarted},
        (404, 409, 507),
        body=schemas.AgentUploadRequest,
        caller="agent",
    )
    async def begin_agent_upload(request: Request, agent: str) -> Response:
        """Called by an agent for one of its devices."""
        caller = await auth.agent(request)
        payload: schemas.AgentUploadRequest = await read(request, schemas.AgentUploadRequest)
        return await _begin(functions, own_device(caller, agent, payload.device), payload, f"agent:{caller.id}")

    @routes.add(
        "POST /agents/{agent}/uploads/{upload}/complete",
        "Complete an upload of an agent",
        schemas.UploadOut,
        (404, 409),
        body=schemas.AgentCompleteRequest,
        caller="agent",
    )
    async def complete_agent_upload(request: Request, agent: str, upload: str) -> Response:
        """Called by an agent. Safe to repeat."""
        caller = await auth.agent(request)
        payload: schemas.AgentCompleteRequest = await read(request, schemas.AgentCompleteRequest)
        capture = await functions.uploads.complete(own_device(caller, agent, payload.device), upload)
        return json_response(_capture_out(capture))


def own_device(caller: Agent, agent: str, name: str) -> Device:
    """The device with this name of the authenticated agent.

    Raises:
        Problem: ``agent-uncaller``, ``device-uncaller``.
    """
    if caller.id != agent or not caller.claimed:
        raise not_found("agent", agent)
    device = next((each for each in devices_of(caller) if each.name == name), None)
    if device is None:
        raise not_found("device", name)
    return device


async def _begin(functions: Functions, device: Device, payload: schemas.UploadRequest, by: str) -> Response:
    announced = Announced(
        stream=payload.stream,
        length=payload.length,
        content_type=payload.content_type,
        name=payload.name,
        at_ms=payload.at_ms,
        sha256=payload.sha256 or "",
    )
    capture, upload = await functions.uploads.begin(device, announced, by=by)
    body = schemas.UploadStarted(
        id=capture.id,
        method=upload.method,
        url=upload.url,
        headers=dict(upload.headers),
        expires_at=rfc3339(capture.created_ms + LIFETIME_S * 1000),
    )
    return json_response(body, 201, headers={"Cache-Control": "no-store"})


def _capture_out(capture: Capture, kind: type[R] = schemas.UploadOut, **more: Any) -> R:  # type: ignore[assignment]
    return response_from(
        capture,
        kind,
        at=rfc3339(capture.at_ms),
        sha256=capture.sha256 or None,
        created_by=capture.by,
        stored_at=rfc3339(capture.stored_ms),
        expires_at=rfc3339(capture.expires_ms),
        **more,
    )
