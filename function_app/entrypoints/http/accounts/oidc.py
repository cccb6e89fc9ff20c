"""Sign-in methods, and sign-in with OpenID Connect."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.accounts.cookies import secure, set_session
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator, reject_cross_site
from function_app.entrypoints.http.framework.responses import json_response, read
from function_app.entrypoints.http.framework.routing import PREFIX, Routes
from function_app.services.accounts.oidc_sign_in import SIGN_IN_TIMEOUT_S, OidcCallback, OidcRedirect
from function_app.settings import Settings

COOKIE = "telescope_sign_in"
_PATH = "/auth/oidc"
_FAILED = "/#sign-in-failed="
Value = Annotated[str, Query(max_length=4000)]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("accounts")
    settings = functions.settings

    @routes.add("GET /auth/methods", "List sign-in methods", schemas.SignInMethodsOut, caller="anonymous")
    async def sign_in_methods(_request: Request) -> Response:
        """Returns the methods that the server accepts. One-time links are always accepted."""
        oidc = settings.oidc
        provider = schemas.OidcProviderOut(name=oidc.name, url=f"{PREFIX}{_PATH}/start") if oidc else None
        return json_response(schemas.SignInMethodsOut(link=True, password=True, oidc=provider))

    @routes.add("GET /auth/oidc/start", "Sign in with OpenID Connect", {303: None}, 404, caller="anonymous")
    async def start_oidc_sign_in(_request: Request) -> Response:
        """Redirects the browser to the OpenID Connect provider (code flow with PKCE) and sets a cookie.

        The cookie is ``SameSite=Lax``, because the browser returns from another site. It can be used once.
        """
        redirect = await functions.oidc_sign_in.begin()
        return _redirect(redirect.address, _state_cookie(settings, redirect))

    @routes.add(
        "POST /auth/oidc/start",
        "Sign in with OpenID Connect and an invitation",
        schemas.OidcSignInOut,
        (403, 404),
        body=schemas.OidcSignInRequest,
        caller="anonymous",
    )
    async def start_oidc_sign_in_with_invitation(request: Request) -> Response:
        """For invited users without an account. The new account redeems the invitation.

        The page opens ``url``, because an invitation's secret must not be part of a URL. A user with an account is
        signed in and can redeem the invitation afterwards.
        """
        reject_cross_site(request)
        payload: schemas.OidcSignInRequest = await read(request, schemas.OidcSignInRequest)
        redirect = await functions.oidc_sign_in.begin(payload.invitation)
        headers = {"Set-Cookie": _state_cookie(settings, redirect), "Cache-Control": "no-store"}
        return json_response(schemas.OidcSignInOut(url=redirect.address), headers=headers)

    @routes.add(
        "GET /auth/oidc/callback", "Finish the OpenID Connect sign-in", {303: None}, (404, 422), caller="anonymous"
    )
    async def finish_oidc_sign_in(
        request: Request, state: Value = "", code: Value = "", iss: Value | None = None, error: Value = ""
    ) -> Response:
        """Sets the session cookie and redirects to the console, which shows the reason if the sign-in failed.

        The session cookie is ``SameSite=Strict``. The browser stores it but does not send it with the redirect, which
        began at another site. The page is public. Its requests come from this site, so they contain the cookie.
        """
        returned = OidcCallback(state, code, request.cookies.get(COOKIE, ""), iss, error)
        try:
            done = await functions.oidc_sign_in.finish(returned, auth.origin(request))
        except Problem as problem:
            if not problem.code.startswith("oidc-") or problem.code == "oidc-unknown":
                raise
            # Keep the cookie: a request from another site must not end a sign-in that this browser started.
            return _redirect(f"{settings.public_url}{_FAILED}{problem.code}")
        return _redirect(f"{settings.public_url}/#/", set_session(settings, done))

    return routes


def _state_cookie(settings: Settings, redirect: OidcRedirect) -> str:
    cookie = f"{COOKIE}={redirect.secret}; Path={PREFIX}{_PATH}; Max-Age={SIGN_IN_TIMEOUT_S}; HttpOnly; SameSite=Lax"
    return cookie + secure(settings)


def _redirect(address: str, cookie: str | None = None) -> Response:
    """A redirect with GET. At most one cookie, because some hosts drop a second ``Set-Cookie``."""
    headers = {"Location": address, "Cache-Control": "no-store"}
    return Response(status_code=303, headers=headers if cookie is None else {**headers, "Set-Cookie": cookie})
