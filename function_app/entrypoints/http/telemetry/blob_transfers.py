"""Presigned URLs of a blob store without an HTTP interface.

The URLs are opaque, like those of S3 and Azure, so they are not part of the OpenAPI document.
"""

import re
from collections.abc import AsyncGenerator
from contextlib import aclosing

from fastapi import APIRouter, Request, Response
from fastapi.responses import StreamingResponse

from function_app.domain.common.problems import Problem, not_found
from function_app.entrypoints.http.framework.routing import PREFIX
from function_app.ports.blobs import TransferRefused, Transfers

PATH = "/blobs"
_DISPLAYABLE = frozenset({"image/jpeg", "image/png", "image/webp"})
"""Content types that a browser may display. All others are untrusted uploads from the server's own origin."""
_RANGE = re.compile(r"\Abytes=(\d{1,15})-(\d{1,15})?\Z")


def router(transfers: Transfers | None) -> APIRouter:
    """The routes; without ``transfers`` they respond with 404."""
    routes = APIRouter(prefix=PREFIX, include_in_schema=False)

    @routes.put(PATH + "/{token}")
    async def receive(request: Request, token: str) -> Response:
        if transfers is None:
            raise not_found("address", token)
        try:
            await transfers.receive(token, request.headers, request.stream())
        except TransferRefused as error:
            raise _problem(error) from error
        return Response(status_code=201)

    @routes.get(PATH + "/{token}")
    async def send(request: Request, token: str) -> Response:
        if transfers is None:
            raise not_found("address", token)
        try:
            blob = await transfers.send(token)
        except TransferRefused as error:
            raise _problem(error) from error
        kind = blob.content_type if blob.content_type in _DISPLAYABLE else "application/octet-stream"
        headers = {"Content-Disposition": "attachment", "Accept-Ranges": "bytes"}
        part = _requested_part(request.headers.get("range", ""), blob.length)
        if part is None:
            headers["Content-Length"] = str(blob.length)
            return StreamingResponse(blob.content, media_type=kind, headers=headers)
        headers |= {
            "Content-Length": str(len(part)),
            "Content-Range": f"bytes {part.start}-{part.stop - 1}/{blob.length}",
        }
        return StreamingResponse(_cut(blob.content, part), 206, media_type=kind, headers=headers)

    return routes


def _requested_part(header: str, length: int) -> range | None:
    """The bytes that a Range header requests; ``None``: all, also for a range that is not supported."""
    match = _RANGE.match(header)
    if match is None:
        return None
    first, last = int(match[1]), int(match[2] or length)
    return range(first, min(last + 1, length)) if first <= last and first < length else None


async def _cut(content: AsyncGenerator[bytes, None], part: range) -> AsyncGenerator[bytes, None]:
    position = 0
    async with aclosing(content):
        async for data in content:
            first, last = max(part.start - position, 0), part.stop - position
            if first < len(data):
                yield data[first:last]
            position += len(data)
            if position >= part.stop:
                return


def _problem(error: TransferRefused) -> Problem:
    return Problem("transfer-rejected", error.status, "The URL is not valid for this request", str(error))
