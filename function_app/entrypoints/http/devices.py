"""``devices``: list, lease, Stop."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.times import rfc3339
from function_app.entrypoints.http import show
from function_app.entrypoints.http.answers import answer, empty, read_or
from function_app.entrypoints.http.caller import Caller
from function_app.entrypoints.http.contract import devices as contract
from function_app.entrypoints.http.routing import Cursor, Limit, Routes

EpochQuery = Annotated[int, Query(ge=1, le=2**53, description="The epoch to give back.")]


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("devices")

    @routes.add("GET", "/devices", summary="Devices one may see", answers={200: contract.DeviceList}, problems=(422,))
    async def list_devices(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """With presence, newest state and lease. A page holds the devices of up to ``limit`` agents."""
        who = await caller.account(request)
        views, following = await functions.devices.views(who, cursor=cursor, limit=limit)
        items = tuple(show.device(view, who) for view in views)
        return answer(contract.DeviceList(items=items, cursor=following))

    @routes.add("GET", "/devices/{device}", summary="One device", answers={200: contract.DeviceOut}, problems=(404,))
    async def get_device(request: Request, device: str) -> Response:
        """With presence, newest state and lease."""
        who = await caller.account(request)
        return answer(show.device(await functions.devices.view(who, device), who))

    @routes.add(
        "GET", "/devices/{device}/lease", summary="Who controls it", answers={200: contract.LeaseNow}, problems=(404,)
    )
    async def get_lease(request: Request, device: str) -> Response:
        """The live lease, or null."""
        who = await caller.account(request)
        return answer(contract.LeaseNow(lease=show.lease(await functions.leases.get(who, device), who)))

    @routes.add(
        "POST",
        "/devices/{device}/lease",
        summary="Take or renew control",
        body=contract.LeaseRequest,
        body_required=False,
        answers={200: contract.LeaseGranted},
        problems=(404, 409),
    )
    async def take_lease(request: Request, device: str) -> Response:
        """Without ``epoch``: take control, with a new epoch. With it: renew that epoch."""
        who = await caller.account(request)
        asked = await read_or(request, contract.LeaseRequest, contract.LeaseRequest())
        lease, confirmed = await functions.leases.take(
            who, device, epoch=asked.epoch, lease_ms=asked.lease_ms, wait_ms=asked.wait_ms
        )
        body = contract.LeaseGranted(
            epoch=lease.epoch,
            holder=lease.holder,
            expires_at=rfc3339(lease.expires_ms),
            lease_ms=lease.lease_ms,
            confirmed=confirmed,
        )
        return answer(body)

    @routes.add(
        "DELETE",
        "/devices/{device}/lease",
        summary="Give control back",
        answers={204: None},
        problems=(404, 409, 422),
    )
    async def release_lease(request: Request, device: str, epoch: EpochQuery) -> Response:
        """What moves is held; credentials for this epoch's setpoints end."""
        await functions.leases.release(await caller.account(request), device, epoch=epoch)
        return empty()

    @routes.add(
        "POST",
        "/devices/{device}/stop",
        summary="Stop",
        body=contract.StopRequest,
        body_required=False,
        answers={200: contract.Confirmed},
        problems=(404,),
    )
    async def stop_device(request: Request, device: str) -> Response:
        """Needs no lease. Latches until it is reset."""
        who = await caller.account(request)
        asked = await read_or(request, contract.StopRequest, contract.StopRequest())
        return answer(contract.Confirmed(confirmed=await functions.stop.stop(who, device, asked.reason)))

    @routes.add(
        "POST",
        "/devices/{device}/stop/reset",
        summary="Release the Stop latch",
        answers={200: contract.Confirmed},
        problems=(404,),
    )
    async def reset_stop(request: Request, device: str) -> Response:
        """Nothing resumes: control must be taken again."""
        who = await caller.account(request)
        return answer(contract.Confirmed(confirmed=await functions.stop.reset(who, device)))

    return routes
