"""Routes with their documentation: what is written here is what the OpenAPI document says."""

from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
from fastapi import APIRouter, Query, Response

from function_app.entrypoints.http.framework import schemas as contract
from function_app.entrypoints.http.framework.api_key_scopes import FOR_KEYS
from function_app.entrypoints.http.framework.responses import JSON, PROBLEM_JSON

Handler = Callable[..., Awaitable[Response]]
Caller = Literal["nobody", "account", "page", "agent", "account or agent"]

PREFIX = "/api/v1"
VERSION = "0.1.0"
Cursor = Annotated[str | None, Query(max_length=2000, description="Where the page before ended.")]
Limit = Annotated[int, Query(ge=1, le=1000, description="At most so many in a page.")]

REF = "#/components/schemas/{name}"
ACCOUNT_SCHEMES = ("accessToken", "sessionCookie")
KEY_SCHEME = "apiKey"
AGENT_SCHEME = "agentToken"
_MEANINGS = {
    200: "Done",
    201: "Made",
    202: "Under way",
    204: "Done, nothing to say",
    303: "Go on there, by GET",
    207: "Partly refused; each item says how it went",
    401: "Not signed in",
    403: "Not allowed",
    404: "There is none",
    409: "Not in this state",
    413: "The body is too large",
    422: "The request is not valid",
    429: "Too many requests or tries; see Retry-After",
    503: "The store or the broker cannot be used; see Retry-After",
}


class Routes:
    """A router for one resource. Handlers take ``request`` and path or query parameters and return a response."""

    def __init__(self, tag: str) -> None:
        self.router = APIRouter(prefix=PREFIX, tags=[tag])
        self.kinds: list[Any] = [contract.Problem]
        """Every struct that its routes have named."""

    def add(
        self,
        method: Literal["GET", "POST", "PUT", "DELETE"],
        path: str,
        *,
        summary: str,
        responses: Mapping[int, Any],
        problems: Sequence[int] = (),
        body: Any = None,
        body_required: bool = True,
        caller: Caller = "account",
    ) -> Callable[[Handler], Handler]:
        """Register a handler.

        Args:
            method: HTTP method.
            path: Below the API's prefix.
            summary: One line.
            responses: Status → struct of the body (``None``: no body; text: the media type of a file).
            problems: Statuses of refusals beside 401, 413, 422, 429 and 503, which follow from the rest.
            body: Struct of the request's body.
            body_required: Whether it may be left out.
            caller: Who may ask; ``page``: an account by its cookie alone. An API key stands for an account where the
                handler's name is in ``FOR_KEYS``.
        """
        refusals = {*problems, 429, 503}
        if caller != "nobody":
            refusals.add(401)
        if caller not in {"nobody", "agent"}:
            refusals.add(403)  # for want of a role or of the page's token, or since an API key may not
        if body is not None:
            refusals |= {413, 422}
        documented: dict[int | str, dict[str, Any]] = {}
        for status, kind in responses.items():
            documented[status] = {"description": _MEANINGS[status]}
            if isinstance(kind, str):
                documented[status]["content"] = {kind: {"schema": {"type": "string", "format": "binary"}}}
            elif kind is not None:
                documented[status]["content"] = {JSON: {"schema": self._reference(kind)}}
        for status in sorted(refusals):
            documented[status] = {
                "description": _MEANINGS[status],
                "content": {PROBLEM_JSON: {"schema": _reference(contract.Problem)}},
            }
        extra: dict[str, Any] = {}
        if body is not None:
            extra["requestBody"] = {"required": body_required, "content": {JSON: {"schema": self._reference(body)}}}

        def register(handler: Handler) -> Handler:
            extra["security"] = _security(caller, for_keys=handler.__name__ in FOR_KEYS)
            self.router.add_api_route(
                path,
                handler,
                methods=[method],
                summary=summary,
                description=(handler.__doc__ or "").strip() or None,
                operation_id=handler.__name__,
                status_code=min(responses),
                response_class=Response,
                response_model=None,
                responses=documented,
                openapi_extra=extra,
            )
            return handler

        return register

    def _reference(self, kind: Any) -> dict[str, Any]:
        self.kinds.append(kind)
        return _reference(kind)


def schemas(kinds: Iterable[Any]) -> dict[str, Any]:
    """JSON Schemas of structs and of all that they hold."""
    _, components = msgspec.json.schema_components(list(dict.fromkeys(kinds)), ref_template=REF)
    return components


def _reference(kind: Any) -> dict[str, Any]:
    """The schema of a struct, or of a union of structs, by reference."""
    (schema,), _ = msgspec.json.schema_components([kind], ref_template=REF)
    return schema


def takes_keys(route: object) -> bool:
    """Whether what is asked for by this route may be asked for with an API key: as its description says."""
    extra = getattr(route, "openapi_extra", None) or {}
    return {KEY_SCHEME: []} in extra.get("security", [])


def _security(caller: Caller, *, for_keys: bool) -> list[dict[str, list[str]]]:
    names: list[str] = []
    if "account" in caller:
        names += ACCOUNT_SCHEMES
    if for_keys:
        names.append(KEY_SCHEME)
    if caller == "page":
        names.append(ACCOUNT_SCHEMES[1])
    if "agent" in caller:
        names.append(AGENT_SCHEME)
    return [{name: []} for name in names]
