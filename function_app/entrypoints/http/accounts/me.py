"""The signed-in account: password and sessions."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.framework.administration import is_administrator
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator, bearer
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("accounts")

    @routes.add("GET /accounts/me", "Get the signed-in account", schemas.AccountOut)
    async def me(request: Request) -> Response:
        """Returns the account and session of the token or cookie; for a cookie also the CSRF token."""
        caller, csrf = (await auth.account(request), None) if bearer(request) else await auth.page(request)
        usage, limits = await functions.quota.usage(caller.account), functions.quota.limits
        storage = schemas.StorageOut(
            used_bytes=usage.total_bytes,
            limit_bytes=limits.account_bytes,
            device_limit_bytes=limits.device_bytes,
            devices=usage.device_bytes,
        )
        body = schemas.AccountOut(
            id=caller.account,
            name=caller.name,
            session=caller.session,
            csrf_token=csrf,
            administrator=is_administrator(caller, functions.settings.administration),
            storage=storage,
        )
        return json_response(body, headers={"Cache-Control": "no-store"})

    @routes.add(
        "PUT /accounts/me/password", "Set or change the password", None, (409, 429), body=schemas.PasswordRequest
    )
    async def put_password(request: Request) -> Response:
        """Ends all other sessions.

        The old password is not required within 10 minutes of signing in with a one-time link.
        """
        caller = await auth.account(request)
        payload: schemas.PasswordRequest = await read(request, schemas.PasswordRequest)
        origin = auth.origin(request)
        await functions.passwords.put(caller, payload.password, old=payload.old_password, origin=origin)
        return empty()

    @routes.add("GET /accounts/me/sessions", "List sign-in sessions", schemas.SessionList)
    async def list_sessions(request: Request) -> Response:
        """Returns active sessions, newest first."""
        caller = await auth.account(request)
        items = tuple(
            schemas.SessionOut(
                id=each.id,
                method=each.how,
                created_at=rfc3339(each.since_ms),
                last_used_at=rfc3339(each.used_ms or each.since_ms),
                expires_at=rfc3339(each.expires_ms),
                address=each.address,
                program=each.program,
                mine=each.id == caller.session,
            )
            for each in await functions.sessions.list(caller.account)
        )
        return json_response(schemas.SessionList(items=items, cursor=None))

    @routes.add("GET /accounts/me/sign-ins", "List recent sign-ins", schemas.SignInList)
    async def list_sign_ins(request: Request) -> Response:
        """Returns past sign-ins, also of ended sessions. No session can remove them; they expire after 30 days."""
        caller = await auth.account(request)
        items = tuple(
            schemas.SignInOut(
                session=each.session,
                method=each.how,
                at=rfc3339(each.at_ms),
                address=each.address,
                program=each.program,
                known_browser=each.known_browser,
                mine=each.session == caller.session,
            )
            for each in await functions.sessions.sign_ins(caller.account)
        )
        return json_response(schemas.SignInList(items=items, cursor=None))

    @routes.add("DELETE /accounts/me/sessions", "End all other sessions", schemas.SessionsEnded)
    async def end_other_sessions(request: Request) -> Response:
        """Ends all sessions except that of the request."""
        return json_response(schemas.SessionsEnded(ended=await functions.sign_out.others(await auth.account(request))))

    @routes.add("DELETE /accounts/me/sessions/{session}", "End a session", None, 404)
    async def end_session(request: Request, session: str) -> Response:
        """Rejects its tokens, closes its broker connections and releases its leases."""
        await functions.sign_out.one(await auth.account(request), session)
        return empty()

    return routes
