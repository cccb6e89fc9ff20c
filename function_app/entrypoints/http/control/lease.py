"""Leases and control requests."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import invalid
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.control import schemas
from function_app.entrypoints.http.control.serializers import control_request_out, lease_out
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read_or, require_empty
from function_app.entrypoints.http.framework.routing import PREFIX, Routes
from function_app.entrypoints.http.framework.schemas import EmptyRequest

EpochQuery = Annotated[int, Query(ge=1, le=2**53, description="The epoch of the lease to release.")]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("control")
    _lease_routes(routes, functions, auth)
    _request_routes(routes, functions, auth)
    return routes


def _lease_routes(routes: Routes, functions: Functions, auth: RequestAuthenticator) -> None:
    @routes.add("GET /devices/{device}/lease", "Get the lease of a device", schemas.LeaseStatus, 404)
    async def get_lease(request: Request, device: str) -> Response:
        """Returns the active lease with its open control request, or null."""
        caller = await auth.account(request)
        lease = await functions.leases.get(caller, device)
        return json_response(schemas.LeaseStatus(lease=lease_out(lease, caller, functions.clock.now_ms())))

    @routes.add(
        "POST /devices/{device}/lease",
        "Acquire, renew or take over control",
        schemas.LeaseGranted,
        (404, 409),
        optional_body=schemas.LeaseRequest,
    )
    async def take_lease(request: Request, device: str) -> Response:
        """Without ``epoch``: acquires a lease with a new epoch. With ``epoch``: renews that lease.

        ``take_over`` takes control from the current holder: the device holds its position, and the holder receives the
        ``reason``. Owners only.
        """
        caller = await auth.account(request)
        payload = await read_or(request, schemas.LeaseRequest, schemas.LeaseRequest())
        over = payload.reason.strip() if payload.take_over else ""
        if payload.take_over and (not over or payload.epoch is not None):
            raise invalid("take_over requires a reason, which is sent to the previous holder, and excludes epoch.")
        lease, confirmed, setpoint_key, streaming = await functions.leases.acquire(
            caller, device, epoch=payload.epoch, lease_ms=payload.lease_ms, wait_ms=payload.wait_ms, over=over
        )
        body = schemas.LeaseGranted(
            epoch=lease.epoch,
            holder=lease.holder,
            expires_at=rfc3339(lease.expires_ms),
            lease_ms=lease.lease_ms,
            confirmed=confirmed,
            setpoint_key=setpoint_key.hex(),
            streaming=streaming,
        )
        return json_response(body, headers={"Cache-Control": "no-store"})

    @routes.add("DELETE /devices/{device}/lease", "Release control", None, (404, 409, 422))
    async def release_lease(request: Request, device: str, epoch: EpochQuery) -> Response:
        """The device holds its position. Credentials for setpoints of this epoch are revoked."""
        await functions.leases.release(await auth.account(request), device, epoch=epoch)
        return empty()


def _request_routes(routes: Routes, functions: Functions, auth: RequestAuthenticator) -> None:
    @routes.add(
        "POST /devices/{device}/lease/requests",
        "Request control",
        {200: schemas.ControlRequestCreated, 201: schemas.ControlRequestCreated},
        (404, 409),
        optional_body=schemas.NewControlRequest,
    )
    async def request_control(request: Request, device: str) -> Response:
        """Requests control from the lease holder.

        The device publishes the request in its ``state``. A repeated request returns the open one (200).

        Without a response within ``within_ms`` the request expires; the lease does not change. The request also ends
        with the lease. Its outcome can be read until the next request.
        """
        caller = await auth.account(request)
        payload = await read_or(request, schemas.NewControlRequest, schemas.NewControlRequest())
        lease, control_request, created, confirmed = await functions.control_requests.create(
            caller, device, within_ms=payload.within_ms, lease_ms=payload.lease_ms, wait_ms=payload.wait_ms
        )
        now_ms = functions.clock.now_ms()
        body = schemas.ControlRequestCreated(
            request=control_request_out(control_request, lease, caller, now_ms), confirmed=confirmed
        )
        headers = {"Location": f"{PREFIX}/devices/{device}/lease/requests/{control_request.id}"}
        return json_response(body, 201 if created else 200, headers)

    @routes.add(
        "GET /devices/{device}/lease/requests/{request_id}", "Get a control request", schemas.ControlRequestOut, 404
    )
    async def get_control_request(request: Request, device: str, request_id: str) -> Response:
        """Returns the last control request of a device, open or closed."""
        caller = await auth.account(request)
        lease, control_request = await functions.control_requests.get(caller, device, request_id)
        return json_response(control_request_out(control_request, lease, caller, functions.clock.now_ms()))

    @routes.add(
        "POST /devices/{device}/lease/requests/{request_id}/accept",
        "Accept a control request",
        schemas.ControlRequestAccepted,
        (404, 409),
        optional_body=schemas.AcceptControlRequest,
    )
    async def accept_control_request(request: Request, device: str, request_id: str) -> Response:
        """Lease holder only. The requester gets a lease with the next epoch; the device holds its position."""
        caller = await auth.account(request)
        payload = await read_or(request, schemas.AcceptControlRequest, schemas.AcceptControlRequest())
        lease, control_request, confirmed = await functions.control_requests.accept(
            caller, device, request_id, wait_ms=payload.wait_ms
        )
        now_ms = functions.clock.now_ms()
        body = schemas.ControlRequestAccepted(
            request=control_request_out(control_request, lease, caller, now_ms),
            epoch=control_request.epoch + 1,
            confirmed=confirmed,
        )
        return json_response(body)

    @routes.add(
        "POST /devices/{device}/lease/requests/{request_id}/reject",
        "Reject a control request",
        schemas.ControlRequestOut,
        (404, 409),
        optional_body=EmptyRequest,
    )
    async def reject_control_request(request: Request, device: str, request_id: str) -> Response:
        """Lease holder only. The lease does not change."""
        caller = await auth.account(request)
        await require_empty(request)
        lease, control_request = await functions.control_requests.reject(caller, device, request_id)
        return json_response(control_request_out(control_request, lease, caller, functions.clock.now_ms()))

    @routes.add("DELETE /devices/{device}/lease/requests/{request_id}", "Withdraw a control request", None, (404, 409))
    async def withdraw_control_request(request: Request, device: str, request_id: str) -> Response:
        """Requester only. 409 if it was accepted: the requester then holds the lease and must release it."""
        await functions.control_requests.withdraw(await auth.account(request), device, request_id)
        return empty()
