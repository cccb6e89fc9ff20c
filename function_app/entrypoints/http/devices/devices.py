"""Devices, their labels and their viewers."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.devices import schemas
from function_app.entrypoints.http.devices.serializers import device_out
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes

_AGAIN_MS = 10_000
"""How soon a page that looks at a device is to say so again."""


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("devices")

    @routes.add("GET /devices", "List devices", schemas.DeviceList, 422)
    async def list_devices(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """With presence, newest state and lease. A page holds the devices of up to ``limit`` agents."""
        caller = await auth.account(request)
        views, following = await functions.devices.views(caller, cursor=cursor, limit=limit)
        items = tuple(device_out(view, caller, functions.clock.now_ms()) for view in views)
        return json_response(schemas.DeviceList(items=items, cursor=following))

    @routes.add("GET /devices/{device}", "Get a device", schemas.DeviceOut, 404)
    async def get_device(request: Request, device: str) -> Response:
        """With presence, newest state and lease."""
        caller = await auth.account(request)
        return json_response(device_out(await functions.devices.view(caller, device), caller, functions.clock.now_ms()))

    _named_and_seen(routes, functions, auth)
    return routes


def _named_and_seen(routes: Routes, functions: Functions, auth: RequestAuthenticator) -> None:
    @routes.add(
        "PUT /devices/{device}/label",
        "Rename a device",
        schemas.DeviceOut,
        (403, 404),
        body=schemas.RenameDeviceRequest,
    )
    async def rename_device(request: Request, device: str) -> Response:
        """Owners only. After a transfer the device has its agent's label again."""
        caller = await auth.account(request)
        payload: schemas.RenameDeviceRequest = await read(request, schemas.RenameDeviceRequest)
        label = None if payload.label is None else " ".join(payload.label.split())
        await functions.rename.rename(caller, device, label)
        return json_response(device_out(await functions.devices.view(caller, device), caller, functions.clock.now_ms()))

    @routes.add("PUT /devices/{device}/viewers", "Register as a viewer and list other viewers", schemas.ViewersOut, 404)
    async def add_viewer(request: Request, device: str) -> Response:
        """For every account that may see the device.

        The registration lasts 25 s; repeating it within 5 s changes nothing.
        """
        caller = await auth.account(request)
        others = tuple(
            schemas.ViewerOut(
                name=other.name,
                role=other.role.value,
                mine=other.account == caller.account,
                since=rfc3339(other.since_ms),
            )
            for other in await functions.viewers.mark(caller, device)
        )
        return json_response(schemas.ViewersOut(items=others, refresh_ms=_AGAIN_MS))

    @routes.add("DELETE /devices/{device}/viewers", "Unregister as a viewer", None, 404)
    async def remove_viewer(request: Request, device: str) -> Response:
        """For this sign-in session. A registration ends after 25 s without renewal."""
        await functions.viewers.leave(await auth.account(request), device)
        return empty()
