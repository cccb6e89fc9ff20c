"""Shares and invitations of devices and spaces, and transfers of spaces and agents."""

from typing import Any, Final, cast

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import NEVER_MS, rfc3339
from function_app.domain.devices.access import Kind, Share, split_target
from function_app.domain.identity.accounts import Identity, Role
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.entrypoints.http.sharing import schemas
from function_app.services.sharing.invitations import KnownInvitation, Offer
from function_app.services.sharing.shares import Target

_INCOMPLETE: Final = (
    "The share is removed. The broker did not respond: the account's connections and its control of the device end as "
    "soon as the broker is reachable."
)


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes, sharing = Routes("sharing"), _Sharing(functions, auth)
    _shares(routes, sharing)
    _invitations(routes, sharing)
    _transfers(routes, sharing)

    @routes.add(
        "POST /invitations/lookup",
        "Look up an invitation",
        schemas.InvitationOut,
        404,
        body=schemas.InvitationLookupRequest,
    )
    async def look_up_invitation(request: Request) -> Response:
        """Requires its secret. Wrong, used, expired and withdrawn invitations cause the same response."""
        await auth.account(request)
        payload: schemas.InvitationLookupRequest = await read(request, schemas.InvitationLookupRequest)
        return json_response(schemas.InvitationOut(**_invitation(await functions.invitations.look(payload.secret))))

    @routes.add(
        "POST /invitations/redeem",
        "Redeem an invitation or accept a transfer",
        schemas.InvitationOut,
        (404, 409),
        body=schemas.RedeemRequest,
    )
    async def redeem_invitation(request: Request) -> Response:
        """Gives the account the offered role. Returns the invitation.

        If several requests compete for the last use, exactly one succeeds.
        """
        caller = await auth.account(request)
        payload: schemas.RedeemRequest = await read(request, schemas.RedeemRequest)
        view = await functions.invitations.look(payload.secret)
        await functions.invitations.redeem(caller, view, space=payload.space)
        return json_response(schemas.InvitationOut(**_invitation(view)))

    return routes


def _shares(routes: Routes, sharing: "_Sharing") -> None:
    @routes.add("GET /devices/{device}/shares", "List shares of a device", schemas.ShareList, (403, 404))
    async def list_device_shares(request: Request, device: str) -> Response:
        """Returns shares of the device, without those of its space. Owners only."""
        return await sharing.list_shares(request, "device", device)

    @routes.add("GET /spaces/{space}/shares", "List shares of a space", schemas.ShareList, (403, 404))
    async def list_space_shares(request: Request, space: str) -> Response:
        """Returns shares of the space. Each applies to all current and future devices in it. Owners only."""
        return await sharing.list_shares(request, "space", space)

    @routes.add(
        "POST /devices/{device}/shares",
        "Share a device",
        {200: schemas.ShareOut, 201: schemas.ShareOut, 202: schemas.ShareOut},
        (404, 409),
        body=schemas.ShareRequest,
    )
    async def share_device(request: Request, device: str) -> Response:
        """Gives another account a role on the device, until the share is removed or expires, or the agent is unpaired.

        202: the role was lowered, but the broker has not confirmed that connections are closed.
        """
        return await sharing.put(request, "device", device)

    @routes.add(
        "POST /spaces/{space}/shares",
        "Share a space",
        {200: schemas.ShareOut, 201: schemas.ShareOut, 202: schemas.ShareOut},
        (404, 409),
        body=schemas.ShareRequest,
    )
    async def share_space(request: Request, space: str) -> Response:
        """Gives another account a role on all current and future devices in the space.

        202: see the share of a device.
        """
        return await sharing.put(request, "space", space)

    @routes.add(
        "DELETE /devices/{device}/shares/{account}",
        "Remove a share of a device",
        {202: schemas.ShareRevocation, 204: None},
        (404, 409),
    )
    async def unshare_device(request: Request, device: str, account: str) -> Response:
        """By its owner or by the account of the share. Ends that account's control and actions immediately.

        202: removed, but the broker has not confirmed that connections are closed.
        """
        return await sharing.end(request, "device", device, account)

    @routes.add(
        "DELETE /spaces/{space}/shares/{account}",
        "Remove a share of a space",
        {202: schemas.ShareRevocation, 204: None},
        (404, 409),
    )
    async def unshare_space(request: Request, space: str, account: str) -> Response:
        """By its owner or by the account of the share.

        Ends that account's control and actions immediately. 202: see the share of a device.
        """
        return await sharing.end(request, "space", space, account)


def _invitations(routes: Routes, sharing: "_Sharing") -> None:
    @routes.add(
        "GET /devices/{device}/invitations", "List open invitations to a device", schemas.InvitationList, (403, 404)
    )
    async def list_device_invitations(request: Request, device: str) -> Response:
        """Returns them without their secrets. Owners only."""
        return await sharing.list_invitations(request, "device", device)

    @routes.add(
        "POST /devices/{device}/invitations",
        "Invite to a device by link",
        {201: schemas.InvitationCreated},
        (404, 409),
        body=schemas.InvitationRequest,
    )
    async def invite_to_device(request: Request, device: str) -> Response:
        """The account that redeems the secret gets the role. The secret is returned only once."""
        return await sharing.invite(request, "device", device)

    @routes.add("DELETE /devices/{device}/invitations/{invitation}", "Withdraw an invitation", None, 404)
    async def withdraw_device_invitation(request: Request, device: str, invitation: str) -> Response:
        """The invitation can no longer be redeemed. Existing shares stay valid."""
        return await sharing.withdraw(request, "device", device, invitation)

    @routes.add(
        "GET /spaces/{space}/invitations", "List open invitations to a space", schemas.InvitationList, (403, 404)
    )
    async def list_space_invitations(request: Request, space: str) -> Response:
        """Returns them without their secrets. Owners only."""
        return await sharing.list_invitations(request, "space", space)

    @routes.add(
        "POST /spaces/{space}/invitations",
        "Invite to a space by link",
        {201: schemas.InvitationCreated},
        (404, 409),
        body=schemas.InvitationRequest,
    )
    async def invite_to_space(request: Request, space: str) -> Response:
        """The account that redeems the secret gets the role. The secret is returned only once."""
        return await sharing.invite(request, "space", space)

    @routes.add("DELETE /spaces/{space}/invitations/{invitation}", "Withdraw an invitation", None, 404)
    async def withdraw_space_invitation(request: Request, space: str, invitation: str) -> Response:
        """The invitation can no longer be redeemed. Existing shares stay valid."""
        return await sharing.withdraw(request, "space", space, invitation)


def _transfers(routes: Routes, sharing: "_Sharing") -> None:
    @routes.add("GET /spaces/{space}/transfers", "List open transfers of a space", schemas.InvitationList, (403, 404))
    async def list_space_transfers(request: Request, space: str) -> Response:
        """Returns them without their secrets. Owners only."""
        return await sharing.list_invitations(request, "space", space, transfers=True)

    @routes.add(
        "POST /spaces/{space}/transfers",
        "Offer a space to another account",
        {201: schemas.InvitationCreated},
        (404, 409),
        body=schemas.TransferRequest,
    )
    async def transfer_space(request: Request, space: str) -> Response:
        """Includes all agents that are in the space at acceptance. The account accepts with ``invitations/redeem``."""
        return await sharing.transfer(request, "space", space)

    @routes.add("DELETE /spaces/{space}/transfers/{invitation}", "Withdraw a transfer", None, 404)
    async def withdraw_space_transfer(request: Request, space: str, invitation: str) -> Response:
        """The transfer can no longer be accepted."""
        return await sharing.withdraw(request, "space", space, invitation)

    @routes.add("GET /agents/{agent}/transfers", "List open transfers of an agent", schemas.InvitationList, (403, 404))
    async def list_agent_transfers(request: Request, agent: str) -> Response:
        """Returns them without their secrets. Owners only."""
        return await sharing.list_invitations(request, "agent", agent, transfers=True)

    @routes.add(
        "POST /agents/{agent}/transfers",
        "Offer an agent to another account",
        {201: schemas.InvitationCreated},
        (404, 409),
        body=schemas.TransferRequest,
    )
    async def transfer_agent(request: Request, agent: str) -> Response:
        """Includes all devices of the agent. The account accepts with ``invitations/redeem``."""
        return await sharing.transfer(request, "agent", agent)

    @routes.add("DELETE /agents/{agent}/transfers/{invitation}", "Withdraw a transfer", None, 404)
    async def withdraw_agent_transfer(request: Request, agent: str, invitation: str) -> Response:
        """The transfer can no longer be accepted."""
        return await sharing.withdraw(request, "agent", agent, invitation)


class _Sharing:
    """Handlers for all kinds of targets."""

    def __init__(self, functions: Functions, auth: RequestAuthenticator) -> None:
        self._functions = functions
        self._auth = auth

    async def _of(self, request: Request, kind: Kind, name: str) -> tuple[Identity, Target]:
        caller = await self._auth.account(request)
        return caller, await self._functions.sharing.of(caller, kind, name)

    async def list_shares(self, request: Request, kind: Kind, name: str) -> Response:
        _, target = await self._of(request, kind, name)
        shares = await self._functions.sharing.shares(target)
        return json_response(schemas.ShareList(items=tuple(_share(*each) for each in shares), cursor=None))

    async def put(self, request: Request, kind: Kind, name: str) -> Response:
        caller = await self._auth.account(request)
        payload: schemas.ShareRequest = await read(request, schemas.ShareRequest)
        sharing = self._functions.sharing
        target = await sharing.of(caller, kind, name)
        person = await sharing.person(payload.account)
        share, created, complete = await sharing.put(caller, target, person, Role(payload.role), payload.expires_in_s)
        return json_response(_share(share, person.name), 202 if not complete else 201 if created else 200)

    async def end(self, request: Request, kind: Kind, name: str, account: str) -> Response:
        caller = await self._auth.account(request)
        sharing = self._functions.sharing
        if account == caller.account:
            complete = await sharing.leave(caller, f"{kind}:{name}")
        else:
            complete = await sharing.end(caller, await sharing.of(caller, kind, name), account)
        return empty() if complete else json_response(schemas.ShareRevocation(detail=_INCOMPLETE), 202)

    async def invite(self, request: Request, kind: Kind, name: str) -> Response:
        caller = await self._auth.account(request)
        payload: schemas.InvitationRequest = await read(request, schemas.InvitationRequest)
        target = await self._functions.sharing.of(caller, kind, name)
        offer = Offer(
            Role(payload.role),
            payload.uses,
            payload.expires_in_s,
            payload.share_s or 0,
            await self._id(payload.account),
        )
        return await self._make(caller, target, offer)

    async def transfer(self, request: Request, kind: Kind, name: str) -> Response:
        caller = await self._auth.account(request)
        payload: schemas.TransferRequest = await read(request, schemas.TransferRequest)
        target = await self._functions.invitations.transferable(caller, kind, name)
        offer = Offer(Role.OWNER, 1, payload.expires_in_s, account=await self._id(payload.account))
        return await self._make(caller, target, offer)

    async def list_invitations(self, request: Request, kind: Kind, name: str, *, transfers: bool = False) -> Response:
        _, target = await self._of(request, kind, name)
        items = [
            schemas.InvitationOut(**_invitation(view), account=await self._only(view.invitation.account))
            for view in await self._functions.invitations.open(target)
            if (view.invitation.role is Role.OWNER) == transfers
        ]
        return json_response(schemas.InvitationList(items=tuple(items), cursor=None))

    async def withdraw(self, request: Request, kind: Kind, name: str, invitation: str) -> Response:
        await self._functions.invitations.withdraw(*await self._of(request, kind, name), invitation)
        return empty()

    async def _only(self, account: str) -> AccountRef | None:
        return AccountRef(id=account, name=await self._functions.sign_in.named(account)) if account else None

    async def _id(self, name: str | None) -> str:
        return "" if name is None else (await self._functions.sharing.person(name)).id

    async def _make(self, caller: Identity, shared: Target, offer: Offer) -> Response:
        secret, view = await self._functions.invitations.make(caller, shared, offer)
        link = f"{self._functions.settings.public_url}/#invitation={secret}"
        body = schemas.InvitationCreated(**_invitation(view), secret=secret, link=link)
        return json_response(body, 201, headers={"Cache-Control": "no-store"})


def _invitation(view: KnownInvitation) -> dict[str, Any]:
    invitation = view.invitation
    kind, target = split_target(invitation.on)
    return {
        "id": view.id,
        "kind": cast("Kind", kind),
        "target": target,
        "label": invitation.label,
        "role": invitation.role.value,
        "created_by": invitation.by,
        "created_by_account": invitation.owner,
        "uses": invitation.uses,
        "share_s": invitation.share_s or None,
        "expires_at": rfc3339(invitation.expires_ms),
    }


def _share(share: Share, name: str) -> schemas.ShareOut:
    return schemas.ShareOut(
        account=AccountRef(id=share.account, name=name),
        role=cast("schemas.SharedRole", share.role.value),
        created_by=share.by,
        created_at=rfc3339(share.created_ms),
        expires_at=None if share.expires_ms >= NEVER_MS else rfc3339(share.expires_ms),
    )
