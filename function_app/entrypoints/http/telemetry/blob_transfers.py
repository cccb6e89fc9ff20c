"""Presigned addresses of blobs that lead to us: of a store that has no HTTP of its own.

They belong to no resource of the API and are not in its description, as S3's and Azure's addresses are not.
"""

from fastapi import APIRouter, Request, Response
from fastapi.responses import StreamingResponse

from function_app.domain.common.problems import Problem, not_found
from function_app.entrypoints.http.framework.routing import PREFIX
from function_app.ports.blobs import TransferRefused, Transfers

PATH = "/blobs"
_SHOWN = frozenset({"image/jpeg", "image/png", "image/webp"})
"""Content types that a browser may display. All others are untrusted uploads from the server's own origin."""


def router(transfers: Transfers | None) -> APIRouter:
    """The routes; without ``transfers`` nothing is behind them."""
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
            found = await transfers.send(token)
        except TransferRefused as error:
            raise _problem(error) from error
        kind = found.content_type if found.content_type in _SHOWN else "application/octet-stream"
        headers = {"Content-Length": str(found.length), "Content-Disposition": "attachment"}
        return StreamingResponse(found.content, media_type=kind, headers=headers)

    return routes


def _problem(error: TransferRefused) -> Problem:
    return Problem("transfer-rejected", error.status, "This address cannot be used so", str(error))
