"""API keys."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.identity.accounts import Role
from function_app.domain.identity.api_keys import ApiKey
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.accounts.api_keys import ApiKeyRequest


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes. They reject API keys: an API key cannot create another."""
    routes = Routes("accounts")

    @routes.add("GET /api-keys", "List API keys", schemas.ApiKeyList)
    async def list_api_keys(request: Request) -> Response:
        """Returns keys without their secrets, newest first. Expired keys stay listed for 30 days."""
        caller = await auth.account(request)
        now_ms = functions.clock.now_ms()
        items = tuple(_show(key, now_ms) for key in await functions.api_keys.of(caller.account))
        return json_response(schemas.ApiKeyList(items=items, cursor=None))

    @routes.add(
        "POST /api-keys", "Create an API key", {201: schemas.ApiKeyCreated}, (404, 409), body=schemas.ApiKeyRequest
    )
    async def create_api_key(request: Request) -> Response:
        """The response contains ``token``, a bearer token for another program. It is returned only once.

        A key has the role viewer or operator. It cannot own, share, pair, save movements, reset a Stop or create keys.
        ``only`` restricts it to devices (ids) and spaces (``space:<id>``).
        """
        caller = await auth.account(request)
        payload: schemas.ApiKeyRequest = await read(request, schemas.ApiKeyRequest)
        key_request = ApiKeyRequest(label=payload.name, most=Role(payload.role), only=payload.only, days=payload.days)
        key, token = await functions.api_keys.make(caller, key_request)
        body = schemas.ApiKeyCreated(api_key=_show(key, functions.clock.now_ms()), token=token)
        return json_response(body, 201, {"Cache-Control": "no-store"})

    @routes.add("DELETE /api-keys/{key}", "Revoke an API key", None, 404)
    async def revoke_api_key(request: Request, key: str) -> Response:
        """Rejects the key, closes its broker connections and releases its leases."""
        await functions.api_keys.revoke(await auth.account(request), key)
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
