"""``auth/methods``, ``auth/oidc``: how one may sign in, and signing in elsewhere."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.accounts.cookies import secure, set_session, whence
from function_app.entrypoints.http.framework.authentication import refuse_other_sites
from function_app.entrypoints.http.framework.responses import answer, read
from function_app.entrypoints.http.framework.routing import PREFIX, Routes
from function_app.services.accounts.oidc_sign_in import BEGUN_S, OidcCallback, OidcRedirect
from function_app.settings import Settings

COOKIE = "telescope_sign_in"
_PATH = "/auth/oidc"
_FAILED = "/#sign-in-failed="
Said = Annotated[str, Query(max_length=4000)]


def router(functions: Functions) -> Routes:
    """The routes."""
    routes = Routes("accounts")
    settings = functions.settings

    @routes.add(
        "GET", "/auth/methods", summary="How one may sign in", answers={200: schemas.SignInMethodsOut}, caller="nobody"
    )
    async def sign_in_methods(_request: Request) -> Response:
        """For the page. A one-time link works everywhere."""
        known = settings.oidc
        elsewhere = schemas.OidcProviderOut(name=known.name, url=f"{PREFIX}{_PATH}/start") if known else None
        return answer(schemas.SignInMethodsOut(link=True, password=True, oidc=elsewhere))

    @routes.add(
        "GET",
        f"{_PATH}/start",
        summary="Sign in elsewhere",
        answers={303: None},
        problems=(404,),
        caller="nobody",
    )
    async def start_oidc_sign_in(_request: Request) -> Response:
        """Sends the browser to the OpenID Connect provider (code flow with PKCE), and marks it with a cookie.

        That cookie is ``SameSite=Lax``, for the browser comes back from another site, and is good for that alone.
        """
        begun = await functions.oidc_sign_in.begin()
        return _redirect(begun.address, _mark(settings, begun))

    @routes.add(
        "POST",
        f"{_PATH}/start",
        summary="Sign in elsewhere with an invitation",
        body=schemas.OidcSignInRequest,
        answers={200: schemas.OidcSignInOut},
        problems=(403, 404),
        caller="nobody",
    )
    async def start_oidc_sign_in_with_invitation(request: Request) -> Response:
        """For who was invited and has no account: as above, and the account that is then made redeems the invitation.

        The page goes on to ``url`` by itself: an invitation's secret belongs in no address. Who has an account
        already is signed in, and redeems it afterwards as always.
        """
        refuse_other_sites(request)
        asked: schemas.OidcSignInRequest = await read(request, schemas.OidcSignInRequest)
        begun = await functions.oidc_sign_in.begin(asked.invitation)
        headers = {"Set-Cookie": _mark(settings, begun), "Cache-Control": "no-store"}
        return answer(schemas.OidcSignInOut(url=begun.address), headers=headers)

    @routes.add(
        "GET",
        f"{_PATH}/callback",
        summary="Come back from there",
        answers={303: None},
        problems=(404, 422),
        caller="nobody",
    )
    async def finish_oidc_sign_in(
        request: Request, state: Said = "", code: Said = "", iss: Said | None = None, error: Said = ""
    ) -> Response:
        """Sets the page's cookie and leads to the page; it says there why somebody was not signed in.

        The session's cookie is ``SameSite=Strict``. A browser stores it from here, for this is what its address bar
        shows, and does not send it with the next step of a way that began at another site. It need not: the page is the
        same for everybody, and what it asks for then is asked by our own site.
        """
        returned = OidcCallback(state, code, request.cookies.get(COOKIE, ""), iss, error)
        try:
            done = await functions.oidc_sign_in.finish(returned, whence(request, settings))
        except Problem as problem:
            if not problem.code.startswith("oidc-") or problem.code == "oidc-unknown":
                raise
            # The mark stays: another site may lead a browser here, and does not spoil what it has begun itself.
            return _redirect(f"{settings.public_url}{_FAILED}{problem.code}")
        return _redirect(f"{settings.public_url}/#/", set_session(settings, done))

    return routes


def _mark(settings: Settings, begun: OidcRedirect) -> str:
    mark = f"{COOKIE}={begun.secret}; Path={PREFIX}{_PATH}; Max-Age={BEGUN_S}; HttpOnly; SameSite=Lax"
    return mark + secure(settings)


def _redirect(address: str, cookie: str | None = None) -> Response:
    """To another address, which is asked for by GET. One cookie at most: not every host carries two."""
    headers = {"Location": address, "Cache-Control": "no-store"}
    return Response(status_code=303, headers=headers if cookie is None else {**headers, "Set-Cookie": cookie})
