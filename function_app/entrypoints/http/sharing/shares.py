"""``devices/{id}/shares`` and ``spaces/{id}/shares``."""

from typing import Final, Literal

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import NEVER_MS, rfc3339
from function_app.domain.devices.access import Share
from function_app.domain.identity.accounts import Role
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, empty, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.entrypoints.http.sharing import schemas

Kind = Literal["device", "space"]
_UNTOLD: Final = (
    "The share has ended, and control under it. The broker did not answer: live sessions are cut, and the device is "
    "told, as soon as it does."
)
_ROLES: Final[dict[Role, schemas.SharedRole]] = {Role.OPERATOR: "operator", Role.VIEWER: "viewer"}


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes, shares = Routes("sharing"), _Shares(functions, caller)

    @routes.add(
        "GET",
        "/devices/{device}/shares",
        summary="With whom a device is shared",
        answers={200: schemas.ShareList},
        problems=(403, 404),
    )
    async def list_device_shares(request: Request, device: str) -> Response:
        """By itself; who has a part in its space is listed there. For its owner."""
        return await shares.list(request, "device", device)

    @routes.add(
        "GET",
        "/spaces/{space}/shares",
        summary="With whom a space is shared",
        answers={200: schemas.ShareList},
        problems=(403, 404),
    )
    async def list_space_shares(request: Request, space: str) -> Response:
        """With every device that is in it, or comes into it. For its owner."""
        return await shares.list(request, "space", space)

    @routes.add(
        "POST",
        "/devices/{device}/shares",
        summary="Share a device",
        body=schemas.ShareRequest,
        answers={200: schemas.ShareOut, 201: schemas.ShareOut, 202: schemas.ShareOut},
        problems=(404, 409),
    )
    async def share_device(request: Request, device: str) -> Response:
        """With another account, until it is ended, its time runs out, or the agent is un-paired.

        202: it was lowered, which ends live sessions, and the broker has not answered yet; see un-sharing.
        """
        return await shares.put(request, "device", device)

    @routes.add(
        "POST",
        "/spaces/{space}/shares",
        summary="Share a space",
        body=schemas.ShareRequest,
        answers={200: schemas.ShareOut, 201: schemas.ShareOut, 202: schemas.ShareOut},
        problems=(404, 409),
    )
    async def share_space(request: Request, space: str) -> Response:
        """With another account: every device that is in it, or comes into it. 202: as for a device."""
        return await shares.put(request, "space", space)

    @routes.add(
        "DELETE",
        "/devices/{device}/shares/{account}",
        summary="Un-share a device",
        answers={202: schemas.ShareRevocation, 204: None},
        problems=(404, 409),
    )
    async def unshare_device(request: Request, device: str, account: str) -> Response:
        """By its owner, or by who gives it back. Ends at once what was done with it: see the architecture page.

        202: it has ended, and the broker has not answered yet; its live sessions are cut as soon as it does.
        """
        return await shares.end(request, "device", device, account)

    @routes.add(
        "DELETE",
        "/spaces/{space}/shares/{account}",
        summary="Un-share a space",
        answers={202: schemas.ShareRevocation, 204: None},
        problems=(404, 409),
    )
    async def unshare_space(request: Request, space: str, account: str) -> Response:
        """By its owner, or by who gives it back. Ends at once what was done in it. 202: as for a device."""
        return await shares.end(request, "space", space, account)

    return routes


class _Shares:
    """The same for devices and spaces."""

    def __init__(self, functions: Functions, caller: Caller) -> None:
        self._functions = functions
        self._caller = caller

    async def list(self, request: Request, kind: Kind, name: str) -> Response:
        shared = await self._functions.sharing.of(await self._caller.account(request), kind, name)
        found = await self._functions.sharing.shares(shared)
        return answer(schemas.ShareList(items=tuple(show(share, named) for share, named in found), cursor=None))

    async def put(self, request: Request, kind: Kind, name: str) -> Response:
        who = await self._caller.account(request)
        asked: schemas.ShareRequest = await read(request, schemas.ShareRequest)
        shared = await self._functions.sharing.of(who, kind, name)
        person = await self._functions.sharing.person(asked.account)
        sharing = self._functions.sharing
        share, fresh, told = await sharing.put(who, shared, person, Role(asked.role), asked.expires_in_s)
        return answer(show(share, person.name), 202 if not told else 201 if fresh else 200)

    async def end(self, request: Request, kind: Kind, name: str, account: str) -> Response:
        who = await self._caller.account(request)
        sharing = self._functions.sharing
        if account == who.account:
            told = await sharing.leave(who, f"{kind}:{name}")
        else:
            told = await sharing.end(who, await sharing.of(who, kind, name), account)
        return empty() if told else answer(schemas.ShareRevocation(detail=_UNTOLD), 202)


def show(share: Share, name: str) -> schemas.ShareOut:
    """A share."""
    return schemas.ShareOut(
        account=AccountRef(id=share.account, name=name),
        role=_ROLES[share.role],
        created_by=share.by,
        created_at=rfc3339(share.created_ms),
        expires_at=None if share.expires_ms >= NEVER_MS else rfc3339(share.expires_ms),
    )
