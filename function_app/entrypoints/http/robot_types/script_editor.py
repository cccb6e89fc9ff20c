"""``robot-types/{type}/scripting``: what editors of movements ask."""

from dataclasses import asdict

import msgspec
from fastapi import Request, Response

from device_agent.protocol.documents.script_api import script_api
from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.services.robot_types.parameter_schema import ObjectSchema
from function_app.services.robot_types.script_linter import check_script, names_of

_SCRIPTING = "/robot-types/{robot_type}/scripting"


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("movements")

    @routes.add(
        "GET",
        _SCRIPTING,
        summary="What a movement script may use",
        answers={200: schemas.ScriptingOut},
        problems=(404, 409),
    )
    async def get_scripting(request: Request, robot_type: str) -> Response:
        """Its calls with their signatures, what it may import, and the names that the robot type has."""
        found = await functions.robot_types.get(await caller.account(request), robot_type)
        return answer(schemas.ScriptingOut(api=script_api(), names=names_of(found)))

    @routes.add(
        "POST",
        _SCRIPTING + "/check",
        summary="Check a script",
        body=schemas.ScriptCheckRequest,
        answers={200: schemas.ScriptCheckOut},
        problems=(404, 409),
    )
    async def check_movement(request: Request, robot_type: str) -> Response:
        """What is wrong with it, with the places; nothing is saved, and nothing of it runs."""
        found = await functions.robot_types.get(await caller.account(request), robot_type)
        asked: schemas.ScriptCheckRequest = await read(request, schemas.ScriptCheckRequest)
        checked = check_script(asked.source, found)
        schema = checked.script.schema if checked.script else None
        return answer(
            schemas.ScriptCheckOut(
                diagnostics=tuple(schemas.ScriptDiagnosticOut(**asdict(mark)) for mark in checked.marks),
                savable=checked.script is not None,
                description=checked.script.description if checked.script else "",
                parameters_schema=None if schema is None else msgspec.convert(schema, ObjectSchema),
            )
        )

    return routes
