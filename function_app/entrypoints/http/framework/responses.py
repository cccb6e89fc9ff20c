"""Converts structs and problems to HTTP responses, and request bodies to structs."""

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec
from fastapi import Request, Response

from function_app.domain.common.problems import Problem, invalid
from function_app.entrypoints.http.framework.schemas import EmptyRequest
from function_app.entrypoints.http.framework.schemas import Problem as ProblemOut

MAX_BODY = 1_000_000
"""Default maximum size of a request body [bytes]."""
_LENGTH_DIGITS = 20
JSON = "application/json"
PROBLEM_JSON = "application/problem+json"

T = TypeVar("T")
_encode = msgspec.json.Encoder().encode
_decoders: dict[Any, msgspec.json.Decoder[Any]] = {}


def json_response(body: Any, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """A JSON response."""
    return Response(_encode(body), status, headers, media_type=JSON)


def content(body: bytes, media_type: str, name: str) -> Response:
    """A file download. Browsers must not display it, because files are untrusted uploads."""
    return Response(body, headers={"Content-Disposition": f'attachment; filename="{name}"'}, media_type=media_type)


def empty(headers: Mapping[str, str] | None = None) -> Response:
    """A response without content (204)."""
    return Response(status_code=204, headers=headers)


def problem(error: Problem) -> Response:
    """An error response with problem details."""
    body = {
        "type": problem_type(error),
        "title": error.title,
        "status": error.status,
        "detail": error.detail,
        **error.extras,
    }
    headers = {} if error.retry_after_s is None else {"Retry-After": str(error.retry_after_s)}
    if error.status == 401:  # noqa: PLR2004
        headers["WWW-Authenticate"] = "Bearer"
    return Response(_encode(body), error.status, headers, media_type=PROBLEM_JSON)


def problem_type(error: Problem) -> str:
    """The URI of the problem type."""
    return f"/problems/{error.code}"


def problem_item(error: Problem) -> ProblemOut:
    """The problem of one item in a response with several items."""
    return ProblemOut(type=problem_type(error), title=error.title, status=error.status, detail=error.detail)


async def read(request: Request, kind: Any, *, limit: int = MAX_BODY) -> Any:
    """The request body, of at most ``limit`` bytes, decoded as ``kind``.

    Raises:
        Problem: ``too-large``; ``invalid``, with the JSON path of the error.
    """
    body = await _bytes(request, limit)
    decoder = _decoders.get(kind)
    if decoder is None:
        decoder = _decoders[kind] = msgspec.json.Decoder(kind, strict=True)
    try:
        return decoder.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise invalid(f"The body does not match the schema: {error}.") from error


async def read_or(request: Request, kind: type[T], default: T) -> T:
    """The request body as in ``read``, or ``default`` if the body is empty."""
    if not await _bytes(request):
        return default
    decoded: T = await read(request, kind)
    return decoded


async def require_empty(request: Request) -> None:
    """Check that the body is empty, or an object without fields.

    Raises:
        Problem: ``too-large``, ``invalid``.
    """
    await read_or(request, EmptyRequest, EmptyRequest())


async def _bytes(request: Request, limit: int = MAX_BODY) -> bytes:
    declared = request.headers.get("content-length", "0")
    if declared.isdecimal() and (len(declared) > _LENGTH_DIGITS or int(declared) > limit):
        raise _too_large(limit)
    cached: bytes | None = getattr(request.state, "body", None)
    if cached is not None:
        return cached
    parts = []
    length = 0
    async for part in request.stream():
        length += len(part)
        if length > limit:
            raise _too_large(limit)
        parts.append(part)
    request.state.body = b"".join(parts)
    body: bytes = request.state.body
    return body


def _too_large(limit: int) -> Problem:
    return Problem("too-large", 413, "Too large", f"The body of this request may have at most {limit} bytes.")
