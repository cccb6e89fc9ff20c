"""``…/invitations`` and ``…/transfers`` of devices, spaces and agents; ``invitations``."""

from typing import Any, Literal, cast

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.access import Kind, split_target
from function_app.domain.identity.accounts import Identity, Role
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, empty, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.entrypoints.http.sharing import schemas
from function_app.services.sharing.invitations import Known, Offer
from function_app.services.sharing.shares import NewShare


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes, invitations = Routes("sharing"), _Invitations(functions, caller)
    _of_devices(routes, invitations)
    _of_spaces(routes, invitations)
    _of_whole_spaces(routes, invitations)
    _of_agents(routes, invitations)

    @routes.add(
        "POST",
        "/invitations/lookup",
        summary="What an invitation offers",
        body=schemas.InvitationLookupRequest,
        answers={200: schemas.InvitationOut},
        problems=(404,),
    )
    async def look_up_invitation(request: Request) -> Response:
        """For whoever has its secret. A wrong, used, expired and withdrawn one are answered alike."""
        await caller.account(request)
        asked: schemas.InvitationLookupRequest = await read(request, schemas.InvitationLookupRequest)
        return answer(schemas.InvitationOut(**_shown(await functions.invitations.look(asked.secret))))

    @routes.add(
        "POST",
        "/invitations/redeem",
        summary="Redeem an invitation, or accept a transfer",
        body=schemas.RedeemRequest,
        answers={200: schemas.InvitationOut},
        problems=(404, 409),
    )
    async def redeem_invitation(request: Request) -> Response:
        """Of several who bring the last use at once one gets it. Gives what it offered."""
        who = await caller.account(request)
        asked: schemas.RedeemRequest = await read(request, schemas.RedeemRequest)
        known = await functions.invitations.look(asked.secret)
        await functions.invitations.redeem(who, known, space=asked.space)
        return answer(schemas.InvitationOut(**_shown(known)))

    return routes


def _of_devices(routes: Routes, invitations: "_Invitations") -> None:
    at = "/devices/{device}/invitations"

    @routes.add(
        "GET", at, summary="Open invitations to a device", answers={200: schemas.InvitationList}, problems=(403, 404)
    )
    async def list_device_invitations(request: Request, device: str) -> Response:
        """Those that can still be redeemed, without their secrets. For its owner."""
        return await invitations.list(request, "device", device)

    @routes.add(
        "POST",
        at,
        summary="Share a device by link",
        body=schemas.InvitationRequest,
        answers={201: schemas.InvitationCreated},
        problems=(404, 409),
    )
    async def invite_to_device(request: Request, device: str) -> Response:
        """Whoever brings the secret in the answer gets a part. It is stored as a hash, and told this once."""
        return await invitations.invite(request, "device", device)

    @routes.add("DELETE", at + "/{invitation}", summary="Take an invitation back", answers={204: None}, problems=(404,))
    async def withdraw_device_invitation(request: Request, device: str, invitation: str) -> Response:
        """Nobody can redeem it any more. What was redeemed stays shared."""
        return await invitations.withdraw(request, "device", device, invitation)


def _of_spaces(routes: Routes, invitations: "_Invitations") -> None:
    at = "/spaces/{space}/invitations"

    @routes.add(
        "GET", at, summary="Open invitations to a space", answers={200: schemas.InvitationList}, problems=(403, 404)
    )
    async def list_space_invitations(request: Request, space: str) -> Response:
        """Those that can still be redeemed, without their secrets. For its owner."""
        return await invitations.list(request, "space", space)

    @routes.add(
        "POST",
        at,
        summary="Share a space by link",
        body=schemas.InvitationRequest,
        answers={201: schemas.InvitationCreated},
        problems=(404, 409),
    )
    async def invite_to_space(request: Request, space: str) -> Response:
        """Whoever brings the secret in the answer gets a part. It is stored as a hash, and told this once."""
        return await invitations.invite(request, "space", space)

    @routes.add("DELETE", at + "/{invitation}", summary="Take an invitation back", answers={204: None}, problems=(404,))
    async def withdraw_space_invitation(request: Request, space: str, invitation: str) -> Response:
        """Nobody can redeem it any more. What was redeemed stays shared."""
        return await invitations.withdraw(request, "space", space, invitation)


def _of_whole_spaces(routes: Routes, invitations: "_Invitations") -> None:
    at = "/spaces/{space}/transfers"

    @routes.add(
        "GET", at, summary="Open transfers of a space", answers={200: schemas.InvitationList}, problems=(403, 404)
    )
    async def list_space_transfers(request: Request, space: str) -> Response:
        """Those that can still be accepted, without their secrets. For its owner."""
        return await invitations.list(request, "space", space, transfers=True)

    @routes.add(
        "POST",
        at,
        summary="Offer a space to another account",
        body=schemas.TransferRequest,
        answers={201: schemas.InvitationCreated},
        problems=(404, 409),
    )
    async def transfer_space(request: Request, space: str) -> Response:
        """With every agent that is in it then. Nothing changes until it is accepted, at ``invitations/redeem``."""
        return await invitations.transfer(request, "space", space)

    @routes.add("DELETE", at + "/{invitation}", summary="Take an offer back", answers={204: None}, problems=(404,))
    async def withdraw_space_transfer(request: Request, space: str, invitation: str) -> Response:
        """Nobody can accept it any more."""
        return await invitations.withdraw(request, "space", space, invitation)


def _of_agents(routes: Routes, invitations: "_Invitations") -> None:
    at = "/agents/{agent}/transfers"

    @routes.add(
        "GET", at, summary="Open transfers of an agent", answers={200: schemas.InvitationList}, problems=(403, 404)
    )
    async def list_agent_transfers(request: Request, agent: str) -> Response:
        """Those that can still be accepted, without their secrets. For its owner."""
        return await invitations.list(request, "agent", agent, transfers=True)

    @routes.add(
        "POST",
        at,
        summary="Offer an agent to another account",
        body=schemas.TransferRequest,
        answers={201: schemas.InvitationCreated},
        problems=(404, 409),
    )
    async def transfer_agent(request: Request, agent: str) -> Response:
        """With all its devices. Nothing changes until it is accepted, at ``invitations/redeem``."""
        return await invitations.transfer(request, "agent", agent)

    @routes.add("DELETE", at + "/{invitation}", summary="Take an offer back", answers={204: None}, problems=(404,))
    async def withdraw_agent_transfer(request: Request, agent: str, invitation: str) -> Response:
        """Nobody can accept it any more."""
        return await invitations.withdraw(request, "agent", agent, invitation)


class _Invitations:
    """The same for all of them."""

    def __init__(self, functions: Functions, caller: Caller) -> None:
        self._functions = functions
        self._caller = caller

    async def invite(self, request: Request, kind: Literal["device", "space"], name: str) -> Response:
        who = await self._caller.account(request)
        asked: schemas.InvitationRequest = await read(request, schemas.InvitationRequest)
        shared = await self._functions.sharing.of(who, kind, name)
        offer = Offer(Role(asked.role), asked.uses, asked.expires_in_s, asked.share_s or 0, await self._id(asked))
        return await self._make(who, shared, offer)

    async def transfer(self, request: Request, kind: Literal["agent", "space"], name: str) -> Response:
        who = await self._caller.account(request)
        asked: schemas.TransferRequest = await read(request, schemas.TransferRequest)
        whole = self._functions.invitations.agent if kind == "agent" else self._functions.invitations.space
        shared = await whole(who, name)
        return await self._make(who, shared, Offer(Role.OWNER, 1, asked.expires_in_s, account=await self._id(asked)))

    async def list(self, request: Request, kind: Kind, name: str, *, transfers: bool = False) -> Response:
        found = await self._functions.invitations.open(await self._of(request, kind, name))
        wanted = [known for known in found if (known.invitation.role is Role.OWNER) == transfers]
        items = [
            schemas.InvitationOut(**_shown(known), account=await self._only(known.invitation.account))
            for known in wanted
        ]
        return answer(schemas.InvitationList(items=tuple(items), cursor=None))

    async def _only(self, account: str) -> AccountRef | None:
        return AccountRef(id=account, name=await self._functions.sign_in.named(account)) if account else None

    async def withdraw(self, request: Request, kind: Kind, name: str, invitation: str) -> Response:
        who = await self._caller.account(request)
        await self._functions.invitations.withdraw(who, await self._of(request, kind, name), invitation)
        return empty()

    async def _of(self, request: Request, kind: Kind, name: str) -> NewShare:
        who = await self._caller.account(request)
        if kind == "agent":
            return await self._functions.invitations.agent(who, name)
        return await self._functions.sharing.of(who, kind, name)

    async def _id(self, asked: schemas.InvitationRequest | schemas.TransferRequest) -> str:
        return (await self._functions.sharing.person(asked.account)).id if asked.account is not None else ""

    async def _make(self, who: Identity, shared: NewShare, offer: Offer) -> Response:
        secret, known = await self._functions.invitations.make(who, shared, offer)
        link = f"{self._functions.settings.public_url}/#invitation={secret}"
        body = schemas.InvitationCreated(**_shown(known), secret=secret, link=link)
        return answer(body, 201, headers={"Cache-Control": "no-store"})


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
