"""The health check of the server."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import store_unavailable
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import VERSION, Routes
from function_app.entrypoints.http.health import schemas


def router(functions: Functions, _auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("health")

    @routes.add("GET /health", "Check the server", schemas.HealthOut, caller="anonymous")
    async def health(_request: Request) -> Response:
        """503: the tables are not available.

        ``degraded``: the broker is not reachable, and the server reconnects; or data of the tables were lost or are
        damaged; or uploaded models are not checked.
        """
        result = await functions.health.check()
        if not result.usable:
            raise store_unavailable(result.tables)
        body = schemas.HealthOut(
            status="ok" if result.tables == result.broker == result.models == "ok" else "degraded",
            version=VERSION,
            tables=result.tables,
            broker=result.broker,
            models=result.models,
        )
        return json_response(body)

    return routes
