"""``devices``: what they are, what their owner calls them, and who looks at them."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.devices import schemas
from function_app.entrypoints.http.devices.serializers import device_out
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, empty, read
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes

_AGAIN_MS = 10_000
"""How soon a page that looks at a device is to say so again."""


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("devices")

    @routes.add("GET", "/devices", summary="Devices one may see", answers={200: schemas.DeviceList}, problems=(422,))
    async def list_devices(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """With presence, newest state and lease. A page holds the devices of up to ``limit`` agents."""
        who = await caller.account(request)
        views, following = await functions.devices.views(who, cursor=cursor, limit=limit)
        items = tuple(device_out(view, who, functions.clock.now_ms()) for view in views)
        return answer(schemas.DeviceList(items=items, cursor=following))

    @routes.add("GET", "/devices/{device}", summary="One device", answers={200: schemas.DeviceOut}, problems=(404,))
    async def get_device(request: Request, device: str) -> Response:
        """With presence, newest state and lease."""
        who = await caller.account(request)
        return answer(device_out(await functions.devices.view(who, device), who, functions.clock.now_ms()))

    _named_and_seen(routes, functions, caller)
    return routes


def _named_and_seen(routes: Routes, functions: Functions, caller: Caller) -> None:
    @routes.add(
        "PUT",
        "/devices/{device}/label",
        summary="Name a device",
        body=schemas.RenameDeviceRequest,
        answers={200: schemas.DeviceOut},
        problems=(403, 404),
    )
    async def rename_device(request: Request, device: str) -> Response:
        """For its owner. Whoever takes it over later finds it called as its agent calls it."""
        who = await caller.account(request)
        asked: schemas.RenameDeviceRequest = await read(request, schemas.RenameDeviceRequest)
        label = None if asked.label is None else " ".join(asked.label.split())
        await functions.rename.rename(who, device, label)
        return answer(device_out(await functions.devices.view(who, device), who, functions.clock.now_ms()))

    @routes.add(
        "PUT",
        "/devices/{device}/viewers",
        summary="Say that one looks at it, and learn who else does",
        answers={200: schemas.ViewersOut},
        problems=(404,),
    )
    async def add_viewer(request: Request, device: str) -> Response:
        """For whoever may see it. It counts for 25 s; what is said more often than every 5 s changes nothing."""
        who = await caller.account(request)
        others = tuple(
            schemas.ViewerOut(
                name=other.name,
                role=other.role.value,
                mine=other.account == who.account,
                since=rfc3339(other.since_ms),
            )
            for other in await functions.viewers.mark(who, device)
        )
        return answer(schemas.ViewersOut(items=others, refresh_ms=_AGAIN_MS))

    @routes.add(
        "DELETE",
        "/devices/{device}/viewers",
        summary="Say that one looks no longer",
        answers={204: None},
        problems=(404,),
    )
    async def remove_viewer(request: Request, device: str) -> Response:
        """Of this sign-in. Whoever says nothing is gone after 25 s too."""
        await functions.viewers.leave(await caller.account(request), device)
        return empty()
