"""Uploads and captures of devices."""

from typing import Any

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import not_found
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.devices import Agent, Device
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.framework.schemas import R, response_from
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
    async def operated(request: Request, device: str) -> tuple[Device, str]:
        caller = await auth.account(request)
        return require_operator(await functions.devices.get(caller, device)), caller.name

    @routes.add(
        "POST /devices/{device}/uploads",
        "Start an upload",
        {201: schemas.UploadStarted},
        (404, 409),
        body=schemas.UploadRequest,
    )
    async def begin_upload(request: Request, device: str) -> Response:
        """Returns a URL for the content, which bypasses this API. Complete the upload afterwards."""
        found, name = await operated(request, device)
        payload: schemas.UploadRequest = await read(request, schemas.UploadRequest)
        return await _begin(functions, found, payload, f"account:{name}")

    @routes.add("POST /devices/{device}/uploads/{upload}/complete", "Complete an upload", schemas.UploadOut, (404, 409))
    async def complete_upload(request: Request, device: str, upload: str) -> Response:
        """Verifies that the content exists and is what was announced. Safe to repeat."""
        found, _ = await operated(request, device)
        return json_response(_show(await functions.uploads.complete(found, upload)))

    @routes.add("GET /devices/{device}/uploads", "List captures of a device", schemas.UploadList, (404, 422))
    async def list_uploads(request: Request, device: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Completed ones, newest first."""
        found = await functions.devices.get(await auth.account(request), device)
        captures, following = await functions.uploads.list(found, cursor=cursor, limit=limit)
        items: tuple[schemas.UploadOut, ...] = tuple(_show(capture) for capture in captures)
        return json_response(schemas.UploadList(items=items, cursor=following))

    @routes.add("GET /devices/{device}/uploads/{upload}", "Get a capture", schemas.UploadWithUrl, 404)
    async def get_upload(request: Request, device: str, upload: str) -> Response:
        """With a URL for its content."""
        found = await functions.devices.get(await auth.account(request), device)
        capture, url = await functions.uploads.get(found, upload)
        return json_response(_show(capture, schemas.UploadWithUrl, url=url), headers={"Cache-Control": "no-store"})

    @routes.add("DELETE /devices/{device}/uploads/{upload}", "Delete a capture", None, 404)
    async def delete_upload(request: Request, device: str, upload: str) -> Response:
        """With its content. Owners only: an operator's captures stay until then."""
        found = require_owner(await functions.devices.get(await auth.account(request), device))
        await functions.uploads.delete(found, upload)
        return empty()


def _for_agents(routes: Routes, functions: Functions, auth: RequestAuthenticator) -> None:
    @routes.add(
        "POST /agents/{agent}/uploads",
        "Start an upload of an agent",
        {201: schemas.UploadStarted},
        (404, 409),
        body=schemas.AgentUploadRequest,
        caller="agent",
    )
    async def begin_agent_upload(request: Request, agent: str) -> Response:
        """Called by an agent, for one of its devices."""
        known = await auth.agent(request)
        payload: schemas.AgentUploadRequest = await read(request, schemas.AgentUploadRequest)
        return await _begin(functions, own_device(known, agent, payload.device), payload, f"agent:{known.id}")

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
        known = await auth.agent(request)
        payload: schemas.AgentCompleteRequest = await read(request, schemas.AgentCompleteRequest)
        capture = await functions.uploads.complete(own_device(known, agent, payload.device), upload)
        return json_response(_show(capture))


def own_device(known: Agent, agent: str, name: str) -> Device:
    """The device of this name of the agent that asks.

    Raises:
        Problem: ``agent-unknown``, ``device-unknown``.
    """
    if known.id != agent or not known.claimed:
        raise not_found("agent", agent)
    device = next((found for found in devices_of(known) if found.name == name), None)
    if device is None:
        raise not_found("device", name)
    return device


async def _begin(functions: Functions, device: Device, payload: schemas.UploadRequest, by: str) -> Response:
    wanted = Announced(
        stream=payload.stream,
        length=payload.length,
        content_type=payload.content_type,
        name=payload.name,
        at_ms=payload.at_ms,
        sha256=payload.sha256 or "",
    )
    capture, upload = await functions.uploads.begin(device, wanted, by=by)
    body = schemas.UploadStarted(
        id=capture.id,
        method=upload.method,
        url=upload.url,
        headers=dict(upload.headers),
        expires_at=rfc3339(capture.created_ms + LIFETIME_S * 1000),
    )
    return json_response(body, 201, headers={"Cache-Control": "no-store"})


def _show(capture: Capture, kind: type[R] = schemas.UploadOut, **more: Any) -> R:  # type: ignore[assignment]
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
