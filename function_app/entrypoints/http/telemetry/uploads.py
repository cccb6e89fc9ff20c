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
        "POST",
        "/devices/{device}/uploads",
        summary="Start an upload",
        body=schemas.UploadRequest,
        responses={201: schemas.UploadStarted},
        problems=(404, 409),
    )
    async def begin_upload(request: Request, device: str) -> Response:
        """Returns a URL for the content, which bypasses this API. Complete the upload afterwards."""
        found, name = await operated(request, device)
        payload: schemas.UploadRequest = await read(request, schemas.UploadRequest)
        return await _begin(functions, found, payload, f"account:{name}")

    @routes.add(
        "POST",
        "/devices/{device}/uploads/{upload}/complete",
        summary="Complete an upload",
        responses={200: schemas.UploadOut},
        problems=(404, 409),
    )
    async def complete_upload(request: Request, device: str, upload: str) -> Response:
        """Verifies that the content exists and is what was announced. Safe to repeat."""
        found, _ = await operated(request, device)
        return json_response(schemas.UploadOut(**_show(await functions.uploads.complete(found, upload))))

    @routes.add(
        "GET",
        "/devices/{device}/uploads",
        summary="List captures of a device",
        responses={200: schemas.UploadList},
        problems=(404, 422),
    )
    async def list_uploads(request: Request, device: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Completed ones, newest first."""
        found = await functions.devices.get(await auth.account(request), device)
        captures, following = await functions.uploads.list(found, cursor=cursor, limit=limit)
        items = tuple(schemas.UploadOut(**_show(capture)) for capture in captures)
        return json_response(schemas.UploadList(items=items, cursor=following))

    @routes.add(
        "GET",
        "/devices/{device}/uploads/{upload}",
        summary="Get a capture",
        responses={200: schemas.UploadWithUrl},
        problems=(404,),
    )
    async def get_upload(request: Request, device: str, upload: str) -> Response:
        """With a URL for its content."""
        found = await functions.devices.get(await auth.account(request), device)
        capture, url = await functions.uploads.get(found, upload)
        return json_response(schemas.UploadWithUrl(url=url, **_show(capture)), headers={"Cache-Control": "no-store"})

    @routes.add(
        "DELETE",
        "/devices/{device}/uploads/{upload}",
        summary="Delete a capture",
        responses={204: None},
        problems=(404,),
    )
    async def delete_upload(request: Request, device: str, upload: str) -> Response:
        """With its content. Owners only: an operator's captures stay until then."""
        found = require_owner(await functions.devices.get(await auth.account(request), device))
        await functions.uploads.delete(found, upload)
        return empty()


def _for_agents(routes: Routes, functions: Functions, auth: RequestAuthenticator) -> None:
    @routes.add(
        "POST",
        "/agents/{agent}/uploads",
        summary="Start an upload of an agent",
        body=schemas.AgentUploadRequest,
        responses={201: schemas.UploadStarted},
        problems=(404, 409),
        caller="agent",
    )
    async def begin_agent_upload(request: Request, agent: str) -> Response:
        """Called by an agent, for one of its devices."""
        known = await auth.agent(request)
        payload: schemas.AgentUploadRequest = await read(request, schemas.AgentUploadRequest)
        return await _begin(functions, _own(known, agent, payload.device), payload, f"agent:{known.id}")

    @routes.add(
        "POST",
        "/agents/{agent}/uploads/{upload}/complete",
        summary="Complete an upload of an agent",
        body=schemas.AgentCompleteRequest,
        responses={200: schemas.UploadOut},
        problems=(404, 409),
        caller="agent",
    )
    async def complete_agent_upload(request: Request, agent: str, upload: str) -> Response:
        """Called by an agent. Safe to repeat."""
        known = await auth.agent(request)
        payload: schemas.AgentCompleteRequest = await read(request, schemas.AgentCompleteRequest)
        capture = await functions.uploads.complete(_own(known, agent, payload.device), upload)
        return json_response(schemas.UploadOut(**_show(capture)))


def _own(known: Agent, agent: str, name: str) -> Device:
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


def _show(capture: Capture) -> dict[str, Any]:
    return {
        "id": capture.id,
        "stream": capture.stream,
        "name": capture.name,
        "at": rfc3339(capture.at_ms),
        "content_type": capture.content_type,
        "length": capture.length,
        "sha256": capture.sha256 or None,
        "verified": capture.verified,
        "created_by": capture.by,
        "stored_at": rfc3339(capture.stored_ms),
        "expires_at": rfc3339(capture.expires_ms),
    }
