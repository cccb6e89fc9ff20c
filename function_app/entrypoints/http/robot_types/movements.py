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

Version = Annotated[int | None, Query(ge=1, le=2**31, description="Version number. Default: the newest version.")]


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
        """Returns built-in movements and the account's own, by name."""
        caller = await auth.account(request)
        found, next_cursor = await functions.movements.list(caller, robot_type, cursor=cursor, limit=limit)
        return json_response(schemas.MovementList(items=tuple(map(movement_out, found)), cursor=next_cursor))

    @routes.add(
        "GET /robot-types/{robot_type}/movements/{name}",
        "Get a movement with its source",
        schemas.MovementSource,
        (404, 409, 422),
    )
    async def get_movement(request: Request, robot_type: str, name: str, version: Version = None) -> Response:
        """Returns the newest or the requested version."""
        caller = await auth.account(request)
        movement, source = await functions.movements.get(caller, robot_type, name, version)
        public = signing.public_text((await functions.keys.archive())[movement.key])
        return json_response(movement_source_out(robot_type, movement, source, public))

    @routes.add(
        "GET /robot-types/{robot_type}/movements/{name}/versions",
        "List versions of a movement",
        schemas.MovementList,
        (404, 409, 422),
    )
    async def list_movement_versions(
        request: Request, robot_type: str, name: str, cursor: Cursor = None, limit: Limit = 100
    ) -> Response:
        """Returns versions, newest first. A built-in movement with the same name is last."""
        caller = await auth.account(request)
        found, next_cursor = await functions.movements.versions(caller, robot_type, name, cursor=cursor, limit=limit)
        return json_response(schemas.MovementList(items=tuple(map(movement_out, found)), cursor=next_cursor))

    @routes.add(
        "PUT /robot-types/{robot_type}/movements/{name}",
        "Save a movement",
        {200: schemas.MovementOut, 201: schemas.MovementOut},
        (404, 409, 507),
        body=schemas.MovementRequest,
    )
    async def put_movement(request: Request, robot_type: str, name: str) -> Response:
        """Stores a new version of the account's own movement. It hides a built-in movement with the same name."""
        caller = await auth.account(request)
        payload: schemas.MovementRequest = await read(request, schemas.MovementRequest)
        schema = None
        if payload.parameters_schema is not None:
            parameter_schema.check_schema(payload.parameters_schema)
            schema = parameter_schema.plain(payload.parameters_schema)
        draft = Draft(payload.source, payload.description, schema, payload.based_on)
        movement, created = await functions.movements.put(caller, robot_type, name, draft)
        return json_response(movement_out(movement), 201 if created else 200)

    @routes.add("DELETE /robot-types/{robot_type}/movements/{name}", "Delete a movement", None, (404, 409))
    async def delete_movement(request: Request, robot_type: str, name: str) -> Response:
        """Deletes all versions of the account's own movement. Running actions continue.

        A built-in movement with the same name becomes visible again.
        """
        await functions.movements.delete(await auth.account(request), robot_type, name)
        return empty()

    return routes
