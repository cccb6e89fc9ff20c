"""``accounts/me``: who is signed in, their password, their sessions."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.accounts.cookies import whence
from function_app.entrypoints.http.framework.authentication import Caller, bearer
from function_app.entrypoints.http.framework.responses import answer, empty, read
from function_app.entrypoints.http.framework.routing import Routes


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("accounts")

    @routes.add("GET", "/accounts/me", summary="Who is signed in", answers={200: schemas.AccountOut})
    async def me(request: Request) -> Response:
        """The account and sign-in session behind the token or cookie; to a page, what it shows with its cookie."""
        who, csrf = (await caller.account(request), None) if bearer(request) else await caller.page(request)
        body = schemas.AccountOut(id=who.account, name=who.name, session=who.session, csrf_token=csrf)
        return answer(body, headers={"Cache-Control": "no-store"})

    @routes.add(
        "PUT",
        "/accounts/me/password",
        summary="Set or change the password",
        body=schemas.PasswordRequest,
        answers={204: None},
        problems=(409, 429),
    )
    async def put_password(request: Request) -> Response:
        """Ends every other session. Without the old one only within 10 minutes of signing in by a one-time link."""
        who = await caller.account(request)
        asked: schemas.PasswordRequest = await read(request, schemas.PasswordRequest)
        place = whence(request, functions.settings)
        await functions.passwords.put(who, asked.password, old=asked.old_password, whence=place)
        return empty()

    @routes.add("GET", "/accounts/me/sessions", summary="One's sign-in sessions", answers={200: schemas.SessionList})
    async def list_sessions(request: Request) -> Response:
        """Those that have not ended, the newest first."""
        who = await caller.account(request)
        items = tuple(
            schemas.SessionOut(
                id=each.id,
                method=each.how,
                created_at=rfc3339(each.since_ms),
                expires_at=rfc3339(each.expires_ms),
                address=each.address,
                program=each.program,
                mine=each.id == who.session,
            )
            for each in await functions.sessions.list(who.account)
        )
        return answer(schemas.SessionList(items=items, cursor=None))

    @routes.add(
        "DELETE",
        "/accounts/me/sessions",
        summary="End every other session",
        answers={200: schemas.SessionsEnded},
    )
    async def end_other_sessions(request: Request) -> Response:
        """The one that asks stays."""
        return answer(schemas.SessionsEnded(ended=await functions.sign_out.others(await caller.account(request))))

    @routes.add(
        "DELETE", "/accounts/me/sessions/{session}", summary="End a session", answers={204: None}, problems=(404,)
    )
    async def end_session(request: Request, session: str) -> Response:
        """Its tokens are refused, its connections to the broker cut, what it controls let go."""
        await functions.sign_out.one(await caller.account(request), session)
        return empty()

    return routes
