"""``devices/{id}/lease``, and ``lease/requests``: asking for control."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import invalid
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.control import schemas
from function_app.entrypoints.http.control.serializers import control_request_out, lease_out
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, empty, read_or
from function_app.entrypoints.http.framework.routing import PREFIX, Routes

EpochQuery = Annotated[int, Query(ge=1, le=2**53, description="The epoch to give back.")]


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("control")
    _holding(routes, functions, caller)
    _asking(routes, functions, caller)
    return routes


def _holding(routes: Routes, functions: Functions, caller: Caller) -> None:
    @routes.add(
        "GET",
        "/devices/{device}/lease",
        summary="Who controls it",
        answers={200: schemas.LeaseStatus},
        problems=(404,),
    )
    async def get_lease(request: Request, device: str) -> Response:
        """The live lease with the open request for it, or null."""
        who = await caller.account(request)
        lease = await functions.leases.get(who, device)
        return answer(schemas.LeaseStatus(lease=lease_out(lease, who, functions.clock.now_ms())))

    @routes.add(
        "POST",
        "/devices/{device}/lease",
        summary="Take, renew or take over control",
        body=schemas.LeaseRequest,
        body_required=False,
        answers={200: schemas.LeaseGranted},
        problems=(404, 409),
    )
    async def take_lease(request: Request, device: str) -> Response:
        """Without ``epoch``: take control, with a new epoch. With it: renew that epoch.

        ``take_over`` takes it from whoever holds it: what moves is held, and they read the ``reason``. Owners only.
        """
        who = await caller.account(request)
        asked = await read_or(request, schemas.LeaseRequest, schemas.LeaseRequest())
        over = asked.reason.strip() if asked.take_over else ""
        if asked.take_over and (not over or asked.epoch is not None):
            raise invalid("take_over wants a reason, which the one who had control will read, and no epoch.")
        lease, confirmed = await functions.leases.acquire(
            who, device, epoch=asked.epoch, lease_ms=asked.lease_ms, wait_ms=asked.wait_ms, over=over
        )
        body = schemas.LeaseGranted(
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
        """What moves is held; credentials for this epoch's setpoints end. Who asks for control may take it then."""
        await functions.leases.release(await caller.account(request), device, epoch=epoch)
        return empty()


def _asking(routes: Routes, functions: Functions, caller: Caller) -> None:
    @routes.add(
        "POST",
        "/devices/{device}/lease/requests",
        summary="Ask for control",
        body=schemas.NewControlRequest,
        body_required=False,
        answers={200: schemas.ControlRequestCreated, 201: schemas.ControlRequestCreated},
        problems=(404, 409),
    )
    async def request_control(request: Request, device: str) -> Response:
        """Of whoever has it; the device shows it in its ``state``. Who asks already is given their request (200).

        Silence takes control from nobody: without an answer within ``within_ms`` it lapses. It also ends with the lease
        that it asks for. What has become of it stays readable until the next request.
        """
        who = await caller.account(request)
        wanted = await read_or(request, schemas.NewControlRequest, schemas.NewControlRequest())
        lease, asked, fresh, shown = await functions.control_requests.create(
            who, device, within_ms=wanted.within_ms, lease_ms=wanted.lease_ms, wait_ms=wanted.wait_ms
        )
        now_ms = functions.clock.now_ms()
        body = schemas.ControlRequestCreated(request=control_request_out(asked, lease, who, now_ms), confirmed=shown)
        where = {"Location": f"{PREFIX}/devices/{device}/lease/requests/{asked.id}"}
        return answer(body, 201 if fresh else 200, where)

    @routes.add(
        "GET",
        "/devices/{device}/lease/requests/{request_id}",
        summary="What became of a request for control",
        answers={200: schemas.ControlRequestOut},
        problems=(404,),
    )
    async def get_control_request(request: Request, device: str, request_id: str) -> Response:
        """The last one is known, whatever has become of it."""
        who = await caller.account(request)
        lease, asked = await functions.control_requests.get(who, device, request_id)
        return answer(control_request_out(asked, lease, who, functions.clock.now_ms()))

    @routes.add(
        "POST",
        "/devices/{device}/lease/requests/{request_id}/accept",
        summary="Hand control over",
        body=schemas.AcceptControlRequest,
        body_required=False,
        answers={200: schemas.ControlRequestAccepted},
        problems=(404, 409),
    )
    async def accept_control_request(request: Request, device: str, request_id: str) -> Response:
        """Only by who has control. In one write the next epoch is the asker's; what moves is held."""
        who = await caller.account(request)
        wanted = await read_or(request, schemas.AcceptControlRequest, schemas.AcceptControlRequest())
        lease, asked, confirmed = await functions.control_requests.accept(
            who, device, request_id, wait_ms=wanted.wait_ms
        )
        now_ms = functions.clock.now_ms()
        body = schemas.ControlRequestAccepted(
            request=control_request_out(asked, lease, who, now_ms), epoch=asked.epoch + 1, confirmed=confirmed
        )
        return answer(body)

    @routes.add(
        "POST",
        "/devices/{device}/lease/requests/{request_id}/reject",
        summary="Keep control",
        answers={200: schemas.ControlRequestOut},
        problems=(404, 409),
    )
    async def reject_control_request(request: Request, device: str, request_id: str) -> Response:
        """Only by who has control."""
        who = await caller.account(request)
        lease, asked = await functions.control_requests.reject(who, device, request_id)
        return answer(control_request_out(asked, lease, who, functions.clock.now_ms()))

    @routes.add(
        "DELETE",
        "/devices/{device}/lease/requests/{request_id}",
        summary="Ask no longer",
        answers={204: None},
        problems=(404, 409),
    )
    async def withdraw_control_request(request: Request, device: str, request_id: str) -> Response:
        """Only by who asked. 409 when it was accepted: control is theirs then, to be given back."""
        await functions.control_requests.withdraw(await caller.account(request), device, request_id)
        return empty()
