"""Answers and problems as HTTP responses; request bodies as structs."""

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec
from fastapi import Request, Response

from function_app.domain.common.problems import Problem, invalid
from function_app.entrypoints.http.framework.schemas import Problem as ProblemOut

MAX_BODY = 1_000_000
"""Bytes of a request's body."""
_LENGTH_DIGITS = 20
JSON = "application/json"
PROBLEM_JSON = "application/problem+json"

T = TypeVar("T")
_encode = msgspec.json.Encoder().encode
_decoders: dict[Any, msgspec.json.Decoder[Any]] = {}


def json_response(body: Any, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """A JSON answer."""
    return Response(_encode(body), status, headers, media_type=JSON)


def content(body: bytes, media_type: str, name: str) -> Response:
    """A file to keep. Never shown in the page: people upload them."""
    return Response(body, headers={"Content-Disposition": f'attachment; filename="{name}"'}, media_type=media_type)


def empty(headers: Mapping[str, str] | None = None) -> Response:
    """Done, nothing to say."""
    return Response(status_code=204, headers=headers)


def problem(error: Problem) -> Response:
    """A refusal."""
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
    """The URI that names the kind of problem."""
    return f"/problems/{error.code}"


def problem_item(error: Problem) -> ProblemOut:
    """A problem of one item of a list."""
    return ProblemOut(type=problem_type(error), title=error.title, status=error.status, detail=error.detail)


async def read(request: Request, kind: Any, *, limit: int = MAX_BODY) -> Any:
    """The request's body, of at most ``limit`` bytes, as ``kind``.

    Raises:
        Problem: ``too-large``, ``invalid`` with the place and what is wrong there.
    """
    body = await _bytes(request, limit)
    decoder = _decoders.get(kind)
    if decoder is None:
        decoder = _decoders[kind] = msgspec.json.Decoder(kind, strict=True)
    try:
        return decoder.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise invalid(f"The body is not what is asked for: {error}.") from error


async def read_or(request: Request, kind: type[T], otherwise: T) -> T:
    """As ``read``; ``otherwise`` where the body is empty."""
    if not await _bytes(request):
        return otherwise
    found: T = await read(request, kind)
    return found


async def _bytes(request: Request, limit: int = MAX_BODY) -> bytes:
    declared = request.headers.get("content-length", "0")
    if declared.isdecimal() and (len(declared) > _LENGTH_DIGITS or int(declared) > limit):
        raise _too_large(limit)
    kept: bytes | None = getattr(request.state, "body", None)
    if kept is not None:
        return kept
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
    return Problem("too-large", 413, "Too large", f"A request's body has at most {limit} bytes here.")
