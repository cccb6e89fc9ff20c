"""``robot-types/{type}/movements``."""

from typing import Annotated

from fastapi import Query, Request, Response

from device_agent.protocol.security import signing
from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, empty, read
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.entrypoints.http.robot_types.serializers import movement_out, movement_source_out
from function_app.services.robot_types import parameter_schema
from function_app.services.robot_types.movements import Draft

_MOVEMENTS = "/robot-types/{robot_type}/movements"
Version = Annotated[int | None, Query(ge=1, le=2**31, description="Not the newest, but this one.")]


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("movements")

    @routes.add(
        "GET",
        _MOVEMENTS,
        summary="Movements of a robot type",
        answers={200: schemas.MovementList},
        problems=(404, 409, 422),
    )
    async def list_movements(request: Request, robot_type: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Built-in ones and the account's own, by name."""
        who = await caller.account(request)
        found, following = await functions.movements.list(who, robot_type, cursor=cursor, limit=limit)
        return answer(schemas.MovementList(items=tuple(movement_out(each) for each in found), cursor=following))

    @routes.add(
        "GET",
        _MOVEMENTS + "/{name}",
        summary="One movement with its source",
        answers={200: schemas.MovementSource},
        problems=(404, 409, 422),
    )
    async def get_movement(request: Request, robot_type: str, name: str, version: Version = None) -> Response:
        """Its newest version, or the one that is asked for."""
        who = await caller.account(request)
        found, source = await functions.movements.get(who, robot_type, name, version)
        public = signing.public_text((await functions.keys.archive())[found.key])
        return answer(movement_source_out(robot_type, found, source, public))

    @routes.add(
        "GET",
        _MOVEMENTS + "/{name}/versions",
        summary="All versions of a movement, newest first",
        answers={200: schemas.MovementList},
        problems=(404, 409, 422),
    )
    async def list_movement_versions(
        request: Request, robot_type: str, name: str, cursor: Cursor = None, limit: Limit = 100
    ) -> Response:
        """The built-in one that it shadows comes last."""
        who = await caller.account(request)
        found, following = await functions.movements.versions(who, robot_type, name, cursor=cursor, limit=limit)
        return answer(schemas.MovementList(items=tuple(movement_out(each) for each in found), cursor=following))

    @routes.add(
        "PUT",
        _MOVEMENTS + "/{name}",
        summary="Save a movement",
        body=schemas.MovementRequest,
        answers={200: schemas.MovementOut, 201: schemas.MovementOut},
        problems=(404, 409),
    )
    async def put_movement(request: Request, robot_type: str, name: str) -> Response:
        """A new version of the account's own; it shadows a built-in one of the same name."""
        who = await caller.account(request)
        asked: schemas.MovementRequest = await read(request, schemas.MovementRequest)
        schema = None
        if asked.parameters_schema is not None:
            parameter_schema.check_schema(asked.parameters_schema)
            schema = parameter_schema.plain(asked.parameters_schema)
        draft = Draft(asked.source, asked.description, schema, asked.based_on)
        found, new = await functions.movements.put(who, robot_type, name, draft)
        return answer(movement_out(found), 201 if new else 200)

    @routes.add(
        "DELETE",
        _MOVEMENTS + "/{name}",
        summary="Delete a movement of one's own",
        answers={204: None},
        problems=(404, 409),
    )
    async def delete_movement(request: Request, robot_type: str, name: str) -> Response:
        """All its versions; a built-in one of the same name shows again. Actions that run it go on to their end."""
        await functions.movements.delete(await caller.account(request), robot_type, name)
        return empty()

    return routes
