"""Sign-in, sign-out and spaces."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import forbidden
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.accounts.cookies import clear_session, signed_in
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator, reject_cross_site
from function_app.entrypoints.http.framework.responses import empty, json_response, read, require_empty
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import AccountRef, EmptyRequest
from function_app.services.devices.spaces import SpaceView


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("accounts")
    settings = functions.settings

    @routes.add(
        "POST /auth/sign-in",
        "Sign in with a one-time link",
        schemas.SignedIn,
        (401, 403),
        body=schemas.LinkSignInRequest,
        caller="anonymous",
    )
    async def sign_in(request: Request) -> Response:
        """Returns an access token for programs and sets a cookie for the console.

        ``second-factor-required``: repeat the request with ``code``. A wrong code does not use up the link.
        """
        reject_cross_site(request)
        payload: schemas.LinkSignInRequest = await read(request, schemas.LinkSignInRequest)
        origin = auth.origin(request, payload.device_token)
        return signed_in(settings, await functions.sign_in.redeem(payload.link, origin, payload.code))

    @routes.add(
        "POST /auth/password",
        "Sign in with name and password",
        schemas.SignedIn,
        (401, 403, 429),
        body=schemas.PasswordSignInRequest,
        caller="anonymous",
    )
    async def sign_in_by_password(request: Request) -> Response:
        """Returns the same as a one-time link, and requires ``code`` in the same way.

        Failed attempts are limited per name and client address, per client address, and per known browser. Many failed
        attempts for one name delay further ones from unknown browsers.
        """
        reject_cross_site(request)
        payload: schemas.PasswordSignInRequest = await read(request, schemas.PasswordSignInRequest)
        origin = auth.origin(request, payload.device_token)
        done = await functions.passwords.sign_in(payload.name, payload.password, origin, payload.code)
        return signed_in(settings, done)

    @routes.add(
        "POST /auth/accounts",
        "Create an account with an invitation",
        {201: schemas.SignedIn},
        (403, 404, 409),
        body=schemas.AccountRequest,
        caller="anonymous",
    )
    async def create_account(request: Request) -> Response:
        """Creates the account, signs in and redeems the invitation.

        If another account takes the last use of the invitation first, the new account exists without shares.
        """
        reject_cross_site(request)
        payload: schemas.AccountRequest = await read(request, schemas.AccountRequest)
        invitation = await functions.invitations.look(payload.invitation)
        if invitation.invitation.account:
            raise forbidden("This invitation is for an existing account. Sign in with that account to redeem it.")
        account = await functions.passwords.register(payload.name, payload.password)
        done = await functions.sessions.begin(account, "password", auth.origin(request))
        await functions.invitations.redeem(Identity(account.id, account.name, done.session), invitation)
        return signed_in(settings, done, 201)

    @routes.add(
        "POST /auth/token", "Renew the access token", schemas.AccessToken, optional_body=EmptyRequest, caller="page"
    )
    async def renew_token(request: Request) -> Response:
        """For programs that store the cookie. An access token is valid for 15 min, the session for 12 h.

        Requires the cookie and the session's CSRF token in ``X-CSRF-Token``. An access token cannot renew itself.
        """
        caller, _ = await auth.page(request)
        await require_empty(request)
        token, lifetime_s = await functions.sessions.access_token(caller)
        body = schemas.AccessToken(
            access_token=token,
            token_type="Bearer",  # noqa: S106 (the name of the scheme)
            expires_in_s=lifetime_s,
        )
        return json_response(body, headers={"Cache-Control": "no-store"})

    @routes.add("POST /auth/sign-out", "Sign out", None, optional_body=EmptyRequest)
    async def sign_out(request: Request) -> Response:
        """Ends the session of the token or cookie, releases its leases, and clears the cookie."""
        caller = await auth.account(request)
        await require_empty(request)
        await functions.sign_out.end(caller)
        return empty({"Set-Cookie": clear_session(settings)})

    @routes.add("GET /spaces", "List spaces", schemas.SpaceList)
    async def list_spaces(request: Request) -> Response:
        """Returns the account's own spaces, which accept agents, and spaces that are shared with it."""
        views = await functions.spaces.list(await auth.account(request))
        return json_response(schemas.SpaceList(items=tuple(_space(view) for view in views), cursor=None))

    @routes.add("POST /spaces", "Create a space", {201: schemas.SpaceOut}, 409, body=schemas.SpaceRequest)
    async def create_space(request: Request) -> Response:
        """Creates a space of the account, into which agents can be claimed."""
        caller = await auth.account(request)
        payload: schemas.SpaceRequest = await read(request, schemas.SpaceRequest)
        space = await functions.sign_in.add_space(caller, payload.name)
        return json_response(_space(await functions.spaces.get(caller, space.id)), 201)

    return routes


def _space(view: SpaceView) -> schemas.SpaceOut:
    owner = AccountRef(id=view.owner.id, name=view.owner.name)
    return schemas.SpaceOut(id=view.space.id, name=view.space.name, role=view.role.value, owner=owner)
