"""Registration of routes with their OpenAPI documentation."""

from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
from fastapi import APIRouter, Query, Response

from function_app.domain.common.timestamps import LAST_MS
from function_app.entrypoints.http.framework import schemas as common
from function_app.entrypoints.http.framework.api_key_scopes import FOR_KEYS
from function_app.entrypoints.http.framework.responses import JSON, PROBLEM_JSON

Handler = Callable[..., Awaitable[Response]]
Caller = Literal["anonymous", "account", "page", "agent", "account or agent"]

PREFIX = "/api/v1"
Cursor = Annotated[str | None, Query(max_length=2000, description="Cursor of the previous page.")]
Since = Annotated[
    int | None,
    Query(alias="from", ge=0, le=LAST_MS, description="First time, inclusive [ms since 1970]. Default: no limit."),
]
Until = Annotated[
    int | None,
    Query(alias="to", ge=0, le=LAST_MS, description="Last time, exclusive [ms since 1970]. Default: no limit."),
]
Limit = Annotated[int, Query(ge=1, le=1000, description="Maximum number of items on a page.")]

REF = "#/components/schemas/{name}"
ACCOUNT_SCHEMES = ("accessToken", "sessionCookie")
KEY_SCHEME = "apiKey"
AGENT_SCHEME = "agentToken"
_MEANINGS = {
    200: "OK",
    201: "Created",
    202: "Accepted; still in progress",
    204: "Done; no content",
    303: "Redirect with GET",
    207: "Partial success; each item has its status",
    401: "Not signed in",
    403: "Not allowed",
    404: "Not found",
    409: "Conflict with the current state",
    412: "Changed since it was read; read it again",
    413: "The body is too large, or the storage of the account or device is used up",
    422: "Invalid request",
    428: "The header If-Match is missing",
    429: "Too many requests; see Retry-After",
    503: "The store or the broker is unavailable; see Retry-After",
    507: "The server's disk is full",
}


class Routes:
    """A router for one resource. Handlers take ``request`` and path or query parameters and return a response."""

    def __init__(self, tag: str) -> None:
        self.router = APIRouter(prefix=PREFIX, tags=[tag])
        self.kinds: list[Any] = [common.Problem]
        """All schemas of the routes."""

    def add(
        self,
        route: str,
        summary: str,
        responses: Any,
        problems: int | Sequence[int] = (),
        *,
        body: Any = None,
        optional_body: Any = None,
        caller: Caller = "account",
    ) -> Callable[[Handler], Handler]:
        """Register a handler.

        Args:
            route: HTTP method and path below the API's prefix, such as ``GET /devices``.
            summary: Summary in the OpenAPI document. The description is the docstring of the handler.
            responses: Status → struct of the body (``None``: no body; text: the media type of a file). A struct or text
                without a mapping: status 200; ``None``: status 204.
            problems: Error statuses in addition to 401, 413, 422, 429 and 503, which follow from the other arguments.
            body: Struct of the request's body.
            optional_body: The same, if the body may be empty.
            caller: Accepted authentication. ``page``: an account's cookie only. An API key acts for an account if the
                handler's name is in ``FOR_KEYS``.
        """
        method, path = route.split()
        kind = optional_body if body is None else body
        error_statuses = {*((problems,) if isinstance(problems, int) else problems), 429, 503}
        if caller != "anonymous":
            error_statuses.add(401)
        if caller not in {"anonymous", "agent"}:
            error_statuses.add(403)  # a missing role or CSRF token, or an operation that rejects API keys
        if kind is not None:
            error_statuses |= {413, 422}
        if not isinstance(responses, Mapping):
            responses = {204 if responses is None else 200: responses}
        documented: dict[int | str, dict[str, Any]] = {
            status: self._success(status, response) for status, response in responses.items()
        }
        for status in sorted(error_statuses):
            documented[status] = {
                "description": _MEANINGS[status],
                "content": {PROBLEM_JSON: {"schema": _reference(common.Problem)}},
            }
        extra: dict[str, Any] = {}
        if kind is not None:
            content = {JSON: {"schema": self._reference(kind)}}
            extra["requestBody"] = {"required": body is not None, "content": content}

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

    def _success(self, status: int, kind: Any) -> dict[str, Any]:
        described: dict[str, Any] = {"description": _MEANINGS[status]}
        if isinstance(kind, str):
            described["content"] = {kind: {"schema": {"type": "string", "format": "binary"}}}
        elif kind is not None:
            described["content"] = {JSON: {"schema": self._reference(kind)}}
        return described

    def _reference(self, kind: Any) -> dict[str, Any]:
        self.kinds.append(kind)
        return _reference(kind)


def schemas(kinds: Iterable[Any]) -> dict[str, Any]:
    """JSON Schemas of structs and of their fields."""
    _, components = msgspec.json.schema_components(list(dict.fromkeys(kinds)), ref_template=REF)
    return components


def _reference(kind: Any) -> dict[str, Any]:
    """The schema of a struct, or of a union of structs, by reference."""
    (schema,), _ = msgspec.json.schema_components([kind], ref_template=REF)
    return schema


def takes_keys(route: object) -> bool:
    """Whether the operation of this route accepts an API key."""
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
