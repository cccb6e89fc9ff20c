"""Movements of a robot type."""

from typing import Annotated

from fastapi import Query, Request, Response

from device_agent.protocol.security import signing
from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.entrypoints.http.robot_types.serializers import movement_out, movement_source_out
from function_app.services.robot_types import parameter_schema
from function_app.services.robot_types.movements import Draft

_MOVEMENTS = "/robot-types/{robot_type}/movements"
Version = Annotated[int | None, Query(ge=1, le=2**31, description="Not the newest, but this one.")]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("movements")

    @routes.add(
        "GET /robot-types/{robot_type}/movements",
        "List movements of a robot type",
        schemas.MovementList,
        (404, 409, 422),
    )
    async def list_movements(request: Request, robot_type: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Built-in movements and the account's own, by name."""
        caller = await auth.account(request)
        found, following = await functions.movements.list(caller, robot_type, cursor=cursor, limit=limit)
        return json_response(schemas.MovementList(items=tuple(movement_out(each) for each in found), cursor=following))

    @routes.add(
        "GET /robot-types/{robot_type}/movements/{name}",
        "Get a movement with its source",
        schemas.MovementSource,
        (404, 409, 422),
    )
    async def get_movement(request: Request, robot_type: str, name: str, version: Version = None) -> Response:
        """The newest version, or the requested one."""
        caller = await auth.account(request)
        found, source = await functions.movements.get(caller, robot_type, name, version)
        public = signing.public_text((await functions.keys.archive())[found.key])
        return json_response(movement_source_out(robot_type, found, source, public))

    @routes.add(
        "GET /robot-types/{robot_type}/movements/{name}/versions",
        "List versions of a movement",
        schemas.MovementList,
        (404, 409, 422),
    )
    async def list_movement_versions(
        request: Request, robot_type: str, name: str, cursor: Cursor = None, limit: Limit = 100
    ) -> Response:
        """Newest first. A built-in movement of the same name comes last."""
        caller = await auth.account(request)
        found, following = await functions.movements.versions(caller, robot_type, name, cursor=cursor, limit=limit)
        return json_response(schemas.MovementList(items=tuple(movement_out(each) for each in found), cursor=following))

    @routes.add(
        "PUT /robot-types/{robot_type}/movements/{name}",
        "Save a movement",
        {200: schemas.MovementOut, 201: schemas.MovementOut},
        (404, 409),
        body=schemas.MovementRequest,
    )
    async def put_movement(request: Request, robot_type: str, name: str) -> Response:
        """Stores a new version of the account's own movement. It replaces a built-in movement of the same name."""
        caller = await auth.account(request)
        payload: schemas.MovementRequest = await read(request, schemas.MovementRequest)
        schema = None
        if payload.parameters_schema is not None:
            parameter_schema.check_schema(payload.parameters_schema)
            schema = parameter_schema.plain(payload.parameters_schema)
        draft = Draft(payload.source, payload.description, schema, payload.based_on)
        found, new = await functions.movements.put(caller, robot_type, name, draft)
        return json_response(movement_out(found), 201 if new else 200)

    @routes.add("DELETE /robot-types/{robot_type}/movements/{name}", "Delete a movement", None, (404, 409))
    async def delete_movement(request: Request, robot_type: str, name: str) -> Response:
        """All versions of the account's own movement.

        A built-in one of the same name becomes visible again. Running actions continue.
        """
        await functions.movements.delete(await auth.account(request), robot_type, name)
        return empty()

    return routes
