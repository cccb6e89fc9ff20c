"""Support for the script editor."""

from dataclasses import asdict

import msgspec
from fastapi import Request, Response

from device_agent.protocol.documents.script_api import script_api
from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.services.robot_types.parameter_schema import ObjectSchema


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("movements")

    @routes.add(
        "GET /robot-types/{robot_type}/scripting",
        "Get the script API for a robot type",
        schemas.ScriptingOut,
        (404, 409),
    )
    async def get_scripting(request: Request, robot_type: str) -> Response:
        """Returns calls with their signatures, importable modules, and names that the robot type defines."""
        from function_app.services.robot_types.script_linter import names_of  # noqa: PLC0415 (parsers slow down a cold start)

        manifest = await functions.robot_types.get(await auth.account(request), robot_type)
        return json_response(schemas.ScriptingOut(api=script_api(), names=names_of(manifest)))

    @routes.add(
        "POST /robot-types/{robot_type}/scripting/check",
        "Check a script",
        schemas.ScriptCheckOut,
        (404, 409),
        body=schemas.ScriptCheckRequest,
    )
    async def check_movement(request: Request, robot_type: str) -> Response:
        """Returns problems with their positions. The script is not saved or run."""
        from function_app.services.robot_types.script_linter import check_script  # noqa: PLC0415 (parsers slow down a cold start)

        manifest = await functions.robot_types.get(await auth.account(request), robot_type)
        payload: schemas.ScriptCheckRequest = await read(request, schemas.ScriptCheckRequest)
        checked = check_script(payload.source, manifest)
        schema = checked.script.schema if checked.script else None
        return json_response(
            schemas.ScriptCheckOut(
                diagnostics=tuple(schemas.ScriptDiagnosticOut(**asdict(mark)) for mark in checked.marks),
                savable=checked.script is not None,
                description=checked.script.description if checked.script else "",
                parameters_schema=None if schema is None else msgspec.convert(schema, ObjectSchema),
            )
        )

    return routes
