"""Shares of devices and spaces."""

from typing import Final, Literal

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import NEVER_MS, rfc3339
from function_app.domain.devices.access import Share
from function_app.domain.identity.accounts import Role
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.entrypoints.http.sharing import schemas

Kind = Literal["device", "space"]
_INCOMPLETE: Final = (
    "The share has ended, and control under it. The broker did not answer: live sessions are cut, and the device is "
    "told, as soon as it does."
)
_ROLES: Final[dict[Role, schemas.SharedRole]] = {Role.OPERATOR: "operator", Role.VIEWER: "viewer"}


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes, shares = Routes("sharing"), _Shares(functions, auth)

    @routes.add(
        "GET",
        "/devices/{device}/shares",
        summary="List shares of a device",
        responses={200: schemas.ShareList},
        problems=(403, 404),
    )
    async def list_device_shares(request: Request, device: str) -> Response:
        """Shares of the device itself; shares of its space are listed there. Owners only."""
        return await shares.list(request, "device", device)

    @routes.add(
        "GET",
        "/spaces/{space}/shares",
        summary="List shares of a space",
        responses={200: schemas.ShareList},
        problems=(403, 404),
    )
    async def list_space_shares(request: Request, space: str) -> Response:
        """Each includes every device in the space, also later ones. Owners only."""
        return await shares.list(request, "space", space)

    @routes.add(
        "POST",
        "/devices/{device}/shares",
        summary="Share a device",
        body=schemas.ShareRequest,
        responses={200: schemas.ShareOut, 201: schemas.ShareOut, 202: schemas.ShareOut},
        problems=(404, 409),
    )
    async def share_device(request: Request, device: str) -> Response:
        """With another account, until it is removed, it expires, or the agent is unpaired.

        202: the role was lowered, which ends sessions, and the broker has not confirmed yet; see the removal of a
        share.
        """
        return await shares.put(request, "device", device)

    @routes.add(
        "POST",
        "/spaces/{space}/shares",
        summary="Share a space",
        body=schemas.ShareRequest,
        responses={200: schemas.ShareOut, 201: schemas.ShareOut, 202: schemas.ShareOut},
        problems=(404, 409),
    )
    async def share_space(request: Request, space: str) -> Response:
        """With another account: every device in the space, also later ones. 202: as for a device."""
        return await shares.put(request, "space", space)

    @routes.add(
        "DELETE",
        "/devices/{device}/shares/{account}",
        summary="Remove a share of a device",
        responses={202: schemas.ShareRevocation, 204: None},
        problems=(404, 409),
    )
    async def unshare_device(request: Request, device: str, account: str) -> Response:
        """By its owner, or by the account itself. Ends that account's control and actions at once.

        202: removed, and the broker has not confirmed yet; connections are closed as soon as it does.
        """
        return await shares.end(request, "device", device, account)

    @routes.add(
        "DELETE",
        "/spaces/{space}/shares/{account}",
        summary="Remove a share of a space",
        responses={202: schemas.ShareRevocation, 204: None},
        problems=(404, 409),
    )
    async def unshare_space(request: Request, space: str, account: str) -> Response:
        """By its owner, or by the account itself.

        Ends that account's control and actions at once. 202: as for a device.
        """
        return await shares.end(request, "space", space, account)

    return routes


class _Shares:
    """The same for devices and spaces."""

    def __init__(self, functions: Functions, auth: RequestAuthenticator) -> None:
        self._functions = functions
        self._auth = auth

    async def list(self, request: Request, kind: Kind, name: str) -> Response:
        shared = await self._functions.sharing.of(await self._auth.account(request), kind, name)
        found = await self._functions.sharing.shares(shared)
        return json_response(schemas.ShareList(items=tuple(show(share, named) for share, named in found), cursor=None))

    async def put(self, request: Request, kind: Kind, name: str) -> Response:
        caller = await self._auth.account(request)
        payload: schemas.ShareRequest = await read(request, schemas.ShareRequest)
        shared = await self._functions.sharing.of(caller, kind, name)
        person = await self._functions.sharing.person(payload.account)
        sharing = self._functions.sharing
        share, created, complete = await sharing.put(caller, shared, person, Role(payload.role), payload.expires_in_s)
        return json_response(show(share, person.name), 202 if not complete else 201 if created else 200)

    async def end(self, request: Request, kind: Kind, name: str, account: str) -> Response:
        caller = await self._auth.account(request)
        sharing = self._functions.sharing
        if account == caller.account:
            complete = await sharing.leave(caller, f"{kind}:{name}")
        else:
            complete = await sharing.end(caller, await sharing.of(caller, kind, name), account)
        return empty() if complete else json_response(schemas.ShareRevocation(detail=_INCOMPLETE), 202)


def show(share: Share, name: str) -> schemas.ShareOut:
    """A share."""
    return schemas.ShareOut(
        account=AccountRef(id=share.account, name=name),
        role=_ROLES[share.role],
        created_by=share.by,
        created_at=rfc3339(share.created_ms),
        expires_at=None if share.expires_ms >= NEVER_MS else rfc3339(share.expires_ms),
    )
