"""Devices, their labels and their viewers."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import invalid
from function_app.domain.common.text import label_error
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.devices import schemas
from function_app.entrypoints.http.devices.serializers import device_out
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read, require_empty
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.framework.schemas import EmptyRequest

_VIEWER_REFRESH_MS = 10_000
"""Interval at which a page must renew its viewer registration."""


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("devices")

    @routes.add("GET /devices", "List devices", schemas.DeviceList, 422)
    async def list_devices(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Returns devices with presence, newest state and lease. A page has the devices of up to ``limit`` agents."""
        caller = await auth.account(request)
        views, next_cursor = await functions.devices.views(caller, cursor=cursor, limit=limit)
        items = tuple(device_out(functions, view, caller) for view in views)
        return json_response(schemas.DeviceList(items=items, cursor=next_cursor))

    @routes.add("GET /devices/{device}", "Get a device", schemas.DeviceOut, 404)
    async def get_device(request: Request, device: str) -> Response:
        """Returns the device with presence, newest state and lease."""
        caller = await auth.account(request)
        return json_response(device_out(functions, await functions.devices.view(caller, device), caller))

    _label_and_viewer_routes(routes, functions, auth)
    return routes


def _label_and_viewer_routes(routes: Routes, functions: Functions, auth: RequestAuthenticator) -> None:
    @routes.add(
        "PUT /devices/{device}/label",
        "Rename a device",
        schemas.DeviceOut,
        (403, 404),
        body=schemas.RenameDeviceRequest,
    )
    async def rename_device(request: Request, device: str) -> Response:
        """Owners only. A transfer of the agent restores the label that the agent reports."""
        caller = await auth.account(request)
        payload: schemas.RenameDeviceRequest = await read(request, schemas.RenameDeviceRequest)
        label = None if payload.label is None else " ".join(payload.label.split())
        error = label_error(label or "")
        if error:
            raise invalid(f"The label {error}.")
        await functions.rename.rename(caller, device, label)
        return json_response(device_out(functions, await functions.devices.view(caller, device), caller))

    @routes.add(
        "PUT /devices/{device}/viewers",
        "Register as a viewer and list other viewers",
        schemas.ViewersOut,
        404,
        optional_body=EmptyRequest,
    )
    async def add_viewer(request: Request, device: str) -> Response:
        """For all accounts with access to the device.

        A registration expires after 25 s. A repetition within 5 s has no effect.
        """
        caller = await auth.account(request)
        await require_empty(request)
        others = tuple(
            schemas.ViewerOut(
                name=other.name,
                account=other.account,
                role=other.role.value,
                mine=other.account == caller.account,
                since=rfc3339(other.since_ms),
            )
            for other in await functions.viewers.mark(caller, device)
        )
        return json_response(schemas.ViewersOut(items=others, refresh_ms=_VIEWER_REFRESH_MS))

    @routes.add("DELETE /devices/{device}/viewers", "Unregister as a viewer", None, 404)
    async def remove_viewer(request: Request, device: str) -> Response:
        """Ends the registration of this sign-in session."""
        await functions.viewers.leave(await auth.account(request), device)
        return empty()
