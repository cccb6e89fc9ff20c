"""``api-keys``."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.identity.accounts import Role
from function_app.domain.identity.api_keys import ApiKey
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, empty, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.accounts.api_keys import ApiKeyRequest


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes. None of them takes a key: a key makes no keys."""
    routes = Routes("accounts")

    @routes.add("GET", "/api-keys", summary="One's API keys", answers={200: schemas.ApiKeyList})
    async def list_api_keys(request: Request) -> Response:
        """The newest first, without their secrets; those that have run out are shown for thirty days more."""
        who = await caller.account(request)
        now_ms = functions.clock.now_ms()
        items = tuple(_show(key, now_ms) for key in await functions.api_keys.of(who.account))
        return answer(schemas.ApiKeyList(items=items, cursor=None))

    @routes.add(
        "POST",
        "/api-keys",
        summary="Make an API key",
        body=schemas.ApiKeyRequest,
        answers={201: schemas.ApiKeyCreated},
        problems=(404, 409),
    )
    async def create_api_key(request: Request) -> Response:
        """For a program of somebody else's, which shows ``token`` as a bearer token. It is told this once.

        A key watches, or operates too; it never owns, shares, pairs, saves movements, resets a Stop or makes keys. It
        may be kept to some devices (their ids) and spaces (``space:<id>``).
        """
        who = await caller.account(request)
        asked: schemas.ApiKeyRequest = await read(request, schemas.ApiKeyRequest)
        wanted = ApiKeyRequest(label=asked.name, most=Role(asked.role), only=asked.only, days=asked.days)
        key, token = await functions.api_keys.make(who, wanted)
        body = schemas.ApiKeyCreated(api_key=_show(key, functions.clock.now_ms()), token=token)
        return answer(body, 201, {"Cache-Control": "no-store"})

    @routes.add("DELETE", "/api-keys/{key}", summary="Revoke an API key", answers={204: None}, problems=(404,))
    async def revoke_api_key(request: Request, key: str) -> Response:
        """It is refused, its connections to the broker are cut, and what it controls is let go."""
        await functions.api_keys.revoke(await caller.account(request), key)
        return empty()

    return routes


def _show(key: ApiKey, now_ms: int) -> schemas.ApiKeyOut:
    return schemas.ApiKeyOut(
        id=key.id,
        name=key.label,
        role=key.most.value,
        only=key.only,
        created_at=rfc3339(key.created_ms),
        expires_at=rfc3339(key.expires_ms),
        expired=now_ms >= key.expires_ms,
        last_used_at=rfc3339(key.used_ms) if key.used_ms else None,
    )
