"""Invitations to devices and spaces, and transfers of spaces and agents."""

from typing import Any, Literal, cast

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.access import Kind, split_target
from function_app.domain.identity.accounts import Identity, Role
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.entrypoints.http.sharing import schemas
from function_app.services.sharing.invitations import Known, Offer
from function_app.services.sharing.shares import NewShare


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes, invitations = Routes("sharing"), _Invitations(functions, auth)
    _of_devices(routes, invitations)
    _of_spaces(routes, invitations)
    _of_whole_spaces(routes, invitations)
    _of_agents(routes, invitations)

    @routes.add(
        "POST",
        "/invitations/lookup",
        summary="Look up an invitation",
        body=schemas.InvitationLookupRequest,
        responses={200: schemas.InvitationOut},
        problems=(404,),
    )
    async def look_up_invitation(request: Request) -> Response:
        """Requires its secret. Wrong, used, expired and withdrawn invitations get the same response."""
        await auth.account(request)
        payload: schemas.InvitationLookupRequest = await read(request, schemas.InvitationLookupRequest)
        return json_response(schemas.InvitationOut(**_shown(await functions.invitations.look(payload.secret))))

    @routes.add(
        "POST",
        "/invitations/redeem",
        summary="Redeem an invitation or accept a transfer",
        body=schemas.RedeemRequest,
        responses={200: schemas.InvitationOut},
        problems=(404, 409),
    )
    async def redeem_invitation(request: Request) -> Response:
        """Of concurrent requests for the last use exactly one succeeds. Returns what it offered."""
        caller = await auth.account(request)
        payload: schemas.RedeemRequest = await read(request, schemas.RedeemRequest)
        known = await functions.invitations.look(payload.secret)
        await functions.invitations.redeem(caller, known, space=payload.space)
        return json_response(schemas.InvitationOut(**_shown(known)))

    return routes


def _of_devices(routes: Routes, invitations: "_Invitations") -> None:
    at = "/devices/{device}/invitations"

    @routes.add(
        "GET",
        at,
        summary="List open invitations to a device",
        responses={200: schemas.InvitationList},
        problems=(403, 404),
    )
    async def list_device_invitations(request: Request, device: str) -> Response:
        """Without their secrets. Owners only."""
        return await invitations.list(request, "device", device)

    @routes.add(
        "POST",
        at,
        summary="Invite to a device by link",
        body=schemas.InvitationRequest,
        responses={201: schemas.InvitationCreated},
        problems=(404, 409),
    )
    async def invite_to_device(request: Request, device: str) -> Response:
        """The account that redeems the secret gets the role. The secret is returned only once."""
        return await invitations.invite(request, "device", device)

    @routes.add(
        "DELETE", at + "/{invitation}", summary="Withdraw an invitation", responses={204: None}, problems=(404,)
    )
    async def withdraw_device_invitation(request: Request, device: str, invitation: str) -> Response:
        """It can no longer be redeemed. Existing shares stay."""
        return await invitations.withdraw(request, "device", device, invitation)


def _of_spaces(routes: Routes, invitations: "_Invitations") -> None:
    at = "/spaces/{space}/invitations"

    @routes.add(
        "GET",
        at,
        summary="List open invitations to a space",
        responses={200: schemas.InvitationList},
        problems=(403, 404),
    )
    async def list_space_invitations(request: Request, space: str) -> Response:
        """Without their secrets. Owners only."""
        return await invitations.list(request, "space", space)

    @routes.add(
        "POST",
        at,
        summary="Invite to a space by link",
        body=schemas.InvitationRequest,
        responses={201: schemas.InvitationCreated},
        problems=(404, 409),
    )
    async def invite_to_space(request: Request, space: str) -> Response:
        """The account that redeems the secret gets the role. The secret is returned only once."""
        return await invitations.invite(request, "space", space)

    @routes.add(
        "DELETE", at + "/{invitation}", summary="Withdraw an invitation", responses={204: None}, problems=(404,)
    )
    async def withdraw_space_invitation(request: Request, space: str, invitation: str) -> Response:
        """It can no longer be redeemed. Existing shares stay."""
        return await invitations.withdraw(request, "space", space, invitation)


def _of_whole_spaces(routes: Routes, invitations: "_Invitations") -> None:
    at = "/spaces/{space}/transfers"

    @routes.add(
        "GET",
        at,
        summary="List open transfers of a space",
        responses={200: schemas.InvitationList},
        problems=(403, 404),
    )
    async def list_space_transfers(request: Request, space: str) -> Response:
        """Without their secrets. Owners only."""
        return await invitations.list(request, "space", space, transfers=True)

    @routes.add(
        "POST",
        at,
        summary="Offer a space to another account",
        body=schemas.TransferRequest,
        responses={201: schemas.InvitationCreated},
        problems=(404, 409),
    )
    async def transfer_space(request: Request, space: str) -> Response:
        """With all agents in it at that time. Nothing changes until it is accepted with ``invitations/redeem``."""
        return await invitations.transfer(request, "space", space)

    @routes.add("DELETE", at + "/{invitation}", summary="Withdraw a transfer", responses={204: None}, problems=(404,))
    async def withdraw_space_transfer(request: Request, space: str, invitation: str) -> Response:
        """It can no longer be accepted."""
        return await invitations.withdraw(request, "space", space, invitation)


def _of_agents(routes: Routes, invitations: "_Invitations") -> None:
    at = "/agents/{agent}/transfers"

    @routes.add(
        "GET",
        at,
        summary="List open transfers of an agent",
        responses={200: schemas.InvitationList},
        problems=(403, 404),
    )
    async def list_agent_transfers(request: Request, agent: str) -> Response:
        """Without their secrets. Owners only."""
        return await invitations.list(request, "agent", agent, transfers=True)

    @routes.add(
        "POST",
        at,
        summary="Offer an agent to another account",
        body=schemas.TransferRequest,
        responses={201: schemas.InvitationCreated},
        problems=(404, 409),
    )
    async def transfer_agent(request: Request, agent: str) -> Response:
        """With all its devices. Nothing changes until it is accepted with ``invitations/redeem``."""
        return await invitations.transfer(request, "agent", agent)

    @routes.add("DELETE", at + "/{invitation}", summary="Withdraw a transfer", responses={204: None}, problems=(404,))
    async def withdraw_agent_transfer(request: Request, agent: str, invitation: str) -> Response:
        """It can no longer be accepted."""
        return await invitations.withdraw(request, "agent", agent, invitation)


class _Invitations:
    """The same for all of them."""

    def __init__(self, functions: Functions, auth: RequestAuthenticator) -> None:
        self._functions = functions
        self._auth = auth

    async def invite(self, request: Request, kind: Literal["device", "space"], name: str) -> Response:
        caller = await self._auth.account(request)
        payload: schemas.InvitationRequest = await read(request, schemas.InvitationRequest)
        shared = await self._functions.sharing.of(caller, kind, name)
        offer = Offer(
            Role(payload.role), payload.uses, payload.expires_in_s, payload.share_s or 0, await self._id(payload)
        )
        return await self._make(caller, shared, offer)

    async def transfer(self, request: Request, kind: Literal["agent", "space"], name: str) -> Response:
        caller = await self._auth.account(request)
        payload: schemas.TransferRequest = await read(request, schemas.TransferRequest)
        whole = self._functions.invitations.agent if kind == "agent" else self._functions.invitations.space
        shared = await whole(caller, name)
        return await self._make(
            caller, shared, Offer(Role.OWNER, 1, payload.expires_in_s, account=await self._id(payload))
        )

    async def list(self, request: Request, kind: Kind, name: str, *, transfers: bool = False) -> Response:
        found = await self._functions.invitations.open(await self._of(request, kind, name))
        wanted = [known for known in found if (known.invitation.role is Role.OWNER) == transfers]
        items = [
            schemas.InvitationOut(**_shown(known), account=await self._only(known.invitation.account))
            for known in wanted
        ]
        return json_response(schemas.InvitationList(items=tuple(items), cursor=None))

    async def _only(self, account: str) -> AccountRef | None:
        return AccountRef(id=account, name=await self._functions.sign_in.named(account)) if account else None

    async def withdraw(self, request: Request, kind: Kind, name: str, invitation: str) -> Response:
        caller = await self._auth.account(request)
        await self._functions.invitations.withdraw(caller, await self._of(request, kind, name), invitation)
        return empty()

    async def _of(self, request: Request, kind: Kind, name: str) -> NewShare:
        caller = await self._auth.account(request)
        if kind == "agent":
            return await self._functions.invitations.agent(caller, name)
        return await self._functions.sharing.of(caller, kind, name)

    async def _id(self, payload: schemas.InvitationRequest | schemas.TransferRequest) -> str:
        return (await self._functions.sharing.person(payload.account)).id if payload.account is not None else ""

    async def _make(self, caller: Identity, shared: NewShare, offer: Offer) -> Response:
        secret, known = await self._functions.invitations.make(caller, shared, offer)
        link = f"{self._functions.settings.public_url}/#invitation={secret}"
        body = schemas.InvitationCreated(**_shown(known), secret=secret, link=link)
        return json_response(body, 201, headers={"Cache-Control": "no-store"})


def _shown(known: Known) -> dict[str, Any]:
    offered = known.invitation
    kind, target = split_target(offered.on)
    return {
        "id": known.id,
        "kind": cast("Kind", kind),
        "target": target,
        "label": offered.label,
        "role": offered.role.value,
        "created_by": offered.by,
        "uses": offered.uses,
        "share_s": offered.share_s or None,
        "expires_at": rfc3339(offered.expires_ms),
    }
