"""``devices``: list, lease, Stop."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http import show
from function_app.entrypoints.http.answers import answer
from function_app.entrypoints.http.caller import Caller
from function_app.entrypoints.http.contract import devices as contract
from function_app.entrypoints.http.routing import Cursor, Limit, Routes


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("devices")

    @routes.add("GET", "/devices", summary="Devices one may see", answers={200: contract.DeviceList}, problems=(422,))
    async def list_devices(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """With presence, newest state and lease. A page holds the devices of up to ``limit`` agents."""
        who = await caller.account(request)
        views, following = await functions.devices.views(who, cursor=cursor, limit=limit)
        items = tuple(show.device(view, who, functions.clock.now_ms()) for view in views)
        return answer(contract.DeviceList(items=items, cursor=following))

    @routes.add("GET", "/devices/{device}", summary="One device", answers={200: contract.DeviceOut}, problems=(404,))
    async def get_device(request: Request, device: str) -> Response:
        """With presence, newest state and lease."""
        who = await caller.account(request)
        return answer(show.device(await functions.devices.view(who, device), who, functions.clock.now_ms()))

    return routes
