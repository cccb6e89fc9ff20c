"""``auth``, ``accounts/me``, ``spaces``."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.answers import answer, empty, read
from function_app.entrypoints.http.caller import COOKIE, Caller
from function_app.entrypoints.http.contract import auth as contract
from function_app.entrypoints.http.routing import Routes
from function_app.services.spaces import SpaceView


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("accounts")
    secure = "; Secure" if functions.settings.public_url.startswith("https:") else ""

    @routes.add(
        "POST",
        "/auth/sign-in",
        summary="Sign in with a one-time link",
        body=contract.SignInRequest,
        answers={200: contract.SignedIn},
        problems=(401,),
        caller="nobody",
    )
    async def sign_in(request: Request) -> Response:
        """Gives an access token for programs, and sets a cookie for the page."""
        asked: contract.SignInRequest = await read(request, contract.SignInRequest)
        done = await functions.sign_in.redeem(asked.link)
        body = contract.SignedIn(
            access_token=done.access_token,
            token_type="Bearer",  # noqa: S106 (a scheme's name)
            expires_in_s=done.expires_in_s,
            account=contract.AccountRef(id=done.account.id, name=done.account.name),
            session=done.session,
        )
        cookie = f"{COOKIE}={done.cookie}; Path=/api; Max-Age={done.cookie_s}; HttpOnly; SameSite=Strict{secure}"
        return answer(body, headers={"Set-Cookie": cookie, "Cache-Control": "no-store"})

    @routes.add("POST", "/auth/sign-out", summary="End this sign-in session", answers={204: None})
    async def sign_out(request: Request) -> Response:
        """Ends the session behind the token or cookie, and clears the cookie."""
        await functions.sign_in.sign_out(await caller.account(request))
        return empty({"Set-Cookie": f"{COOKIE}=; Path=/api; Max-Age=0; HttpOnly; SameSite=Strict{secure}"})

    @routes.add("GET", "/accounts/me", summary="Who is signed in", answers={200: contract.Me})
    async def me(request: Request) -> Response:
        """The account and sign-in session behind the token or cookie."""
        who = await caller.account(request)
        return answer(contract.Me(id=who.account, name=who.name, session=who.session))

    @routes.add("GET", "/spaces", summary="Spaces one may see", answers={200: contract.SpaceList})
    async def list_spaces(request: Request) -> Response:
        """One's own, into which agents can be claimed, and those that are shared with one."""
        views = await functions.spaces.list(await caller.account(request))
        return answer(contract.SpaceList(items=tuple(_space(view) for view in views), cursor=None))

    @routes.add(
        "POST",
        "/spaces",
        summary="Make a space",
        body=contract.SpaceRequest,
        answers={201: contract.SpaceOut},
        problems=(409,),
    )
    async def make_space(request: Request) -> Response:
        """A further room for agents."""
        who = await caller.account(request)
        asked: contract.SpaceRequest = await read(request, contract.SpaceRequest)
        space = await functions.sign_in.add_space(who, asked.name)
        return answer(_space(await functions.spaces.get(who, space.id)), 201)

    return routes


def _space(view: SpaceView) -> contract.SpaceOut:
    owner = contract.AccountRef(id=view.owner.id, name=view.owner.name)
    return contract.SpaceOut(id=view.space.id, name=view.space.name, role=view.role.value, owner=owner)
