"""Presigned URLs of a blob store without an HTTP interface.

The URLs are opaque, like those of S3 and Azure, so they are not part of the OpenAPI document.
"""

from fastapi import APIRouter, Request, Response
from fastapi.responses import StreamingResponse

from function_app.domain.common.problems import Problem, not_found
from function_app.entrypoints.http.framework.routing import PREFIX
from function_app.ports.blobs import TransferRefused, Transfers

PATH = "/blobs"
_DISPLAYABLE = frozenset({"image/jpeg", "image/png", "image/webp"})
"""Content types that a browser may display. All others are untrusted uploads from the server's own origin."""


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
    async def send(token: str) -> Response:
        if transfers is None:
            raise not_found("address", token)
        try:
            blob = await transfers.send(token)
        except TransferRefused as error:
            raise _problem(error) from error
        kind = blob.content_type if blob.content_type in _DISPLAYABLE else "application/octet-stream"
        headers = {"Content-Length": str(blob.length), "Content-Disposition": "attachment"}
        return StreamingResponse(blob.content, media_type=kind, headers=headers)

    return routes


def _problem(error: TransferRefused) -> Problem:
    return Problem("transfer-rejected", error.status, "The URL is not valid for this request", str(error))
