"""``auth``, ``spaces``."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import forbidden
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.accounts.cookies import clear_session, signed_in, whence
from function_app.entrypoints.http.framework.authentication import Caller, refuse_other_sites
from function_app.entrypoints.http.framework.responses import answer, empty, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.services.devices.spaces import SpaceView


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("accounts")
    settings = functions.settings

    @routes.add(
        "POST",
        "/auth/sign-in",
        summary="Sign in with a one-time link",
        body=schemas.LinkSignInRequest,
        answers={200: schemas.SignedIn},
        problems=(401, 403),
        caller="nobody",
    )
    async def sign_in(request: Request) -> Response:
        """Gives an access token for programs, and sets a cookie for the page."""
        refuse_other_sites(request)
        asked: schemas.LinkSignInRequest = await read(request, schemas.LinkSignInRequest)
        return signed_in(settings, await functions.sign_in.redeem(asked.link, whence(request, settings)))

    @routes.add(
        "POST",
        "/auth/password",
        summary="Sign in with name and password",
        body=schemas.PasswordSignInRequest,
        answers={200: schemas.SignedIn},
        problems=(401, 403, 429),
        caller="nobody",
    )
    async def sign_in_by_password(request: Request) -> Response:
        """As with a link. Wrong ones are counted by the name and by the address that asks."""
        refuse_other_sites(request)
        asked: schemas.PasswordSignInRequest = await read(request, schemas.PasswordSignInRequest)
        done = await functions.passwords.sign_in(asked.name, asked.password, whence(request, settings))
        return signed_in(settings, done)

    @routes.add(
        "POST",
        "/auth/accounts",
        summary="Make an account with an invitation",
        body=schemas.AccountRequest,
        answers={201: schemas.SignedIn},
        problems=(403, 404, 409),
        caller="nobody",
    )
    async def create_account(request: Request) -> Response:
        """For who was invited and has no account: makes one, signs in, and redeems the invitation.

        Where somebody else is first with its last use the account is there all the same, and empty.
        """
        refuse_other_sites(request)
        asked: schemas.AccountRequest = await read(request, schemas.AccountRequest)
        known = await functions.invitations.look(asked.invitation)
        if known.invitation.account:
            raise forbidden("This invitation is for somebody who has an account. Sign in as the one it was made for.")
        account = await functions.passwords.register(asked.name, asked.password)
        done = await functions.sessions.begin(account, "password", whence(request, settings))
        await functions.invitations.redeem(Identity(account.id, account.name, done.session), known)
        return signed_in(settings, done, 201)

    @routes.add(
        "POST", "/auth/token", summary="The next access token", answers={200: schemas.AccessToken}, caller="page"
    )
    async def renew_token(request: Request) -> Response:
        """For programs that keep the cookie: an access token ends after a quarter of an hour, the session after 12 h.

        Needs the cookie, and the session's CSRF token in ``X-CSRF-Token``: no access token lives on by itself.
        """
        who, _ = await caller.page(request)
        token, lifetime_s = await functions.sessions.access_token(who)
        body = schemas.AccessToken(
            access_token=token,
            token_type="Bearer",  # noqa: S106 (a scheme's name)
            expires_in_s=lifetime_s,
        )
        return answer(body, headers={"Cache-Control": "no-store"})

    @routes.add("POST", "/auth/sign-out", summary="End this sign-in session", answers={204: None})
    async def sign_out(request: Request) -> Response:
        """Ends the session behind the token or cookie with all that it holds, and clears the cookie."""
        await functions.sign_out.end(await caller.account(request))
        return empty({"Set-Cookie": clear_session(settings)})

    @routes.add("GET", "/spaces", summary="Spaces one may see", answers={200: schemas.SpaceList})
    async def list_spaces(request: Request) -> Response:
        """One's own, into which agents can be claimed, and those that are shared with one."""
        views = await functions.spaces.list(await caller.account(request))
        return answer(schemas.SpaceList(items=tuple(_space(view) for view in views), cursor=None))

    @routes.add(
        "POST",
        "/spaces",
        summary="Make a space",
        body=schemas.SpaceRequest,
        answers={201: schemas.SpaceOut},
        problems=(409,),
    )
    async def create_space(request: Request) -> Response:
        """A further room for agents."""
        who = await caller.account(request)
        asked: schemas.SpaceRequest = await read(request, schemas.SpaceRequest)
        space = await functions.sign_in.add_space(who, asked.name)
        return answer(_space(await functions.spaces.get(who, space.id)), 201)

    return routes


def _space(view: SpaceView) -> schemas.SpaceOut:
    owner = AccountRef(id=view.owner.id, name=view.owner.name)
    return schemas.SpaceOut(id=view.space.id, name=view.space.name, role=view.role.value, owner=owner)
