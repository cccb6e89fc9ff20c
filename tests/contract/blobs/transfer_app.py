"""Serves the presigned URLs of stores without an HTTP interface of their own."""

from fastapi import FastAPI, Response

from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.framework.routing import PREFIX
from function_app.entrypoints.http.telemetry import blob_transfers
from function_app.ports.blobs import Transfers

PATH = f"{PREFIX}/blobs"


def transfer_app(transfers: Transfers) -> FastAPI:
    """The API of a store's presigned URLs, at ``PATH``."""
    app = FastAPI()
    app.include_router(blob_transfers.router(transfers))
    app.add_exception_handler(Problem, lambda _, error: Response(str(error), getattr(error, "status", 500)))
    return app
