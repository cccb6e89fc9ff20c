"""Robot types."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import content, empty, json_response, read
from function_app.entrypoints.http.framework.routing import PREFIX, Cursor, Limit, Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.entrypoints.http.robot_types.serializers import robot_type_out, twin_out

_BYTES = "application/octet-stream"
_ZIP = "application/zip"


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("robot types")

    @routes.add("GET /robot-types", "List robot types", schemas.RobotTypeList, 422)
    async def list_robot_types(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Returns built-in robot types and the account's own."""
        caller = await auth.account(request)
        types, next_cursor = await functions.robot_types.list(caller, cursor=cursor, limit=limit)
        return json_response(schemas.RobotTypeList(items=tuple(map(robot_type_out, types)), cursor=next_cursor))

    @routes.add(
        "POST /robot-types",
        "Upload a robot type",
        {200: schemas.RobotTypeOut, 201: schemas.RobotTypeOut, 202: schemas.RobotTypeOut},
        (404, 409, 507),
        body=schemas.RobotTypeRequest,
    )
    async def add_robot_type(request: Request) -> Response:
        """Compiles the model with MuJoCo and compares it with the manifest.

        201: created; 200: a new version was created; 202: the validation has not finished, poll the robot type;
        422 ``robot-type-rejected``: ``errors`` contains the reasons.
        """
        caller = await auth.account(request)
        payload: schemas.RobotTypeRequest = await read(request, schemas.RobotTypeRequest, limit=schemas.MAX_UPLOAD)
        view, created = await functions.upload_robot_type.upload(
            caller, payload.manifest, payload.files, wait_ms=payload.wait_ms
        )
        status = 201 if created else 200
        if view.upload is not None and view.upload.open:
            status = 202
        headers = {"Location": f"{PREFIX}/robot-types/{view.manifest.type}"}
        return json_response(robot_type_out(view), status, headers)

    @routes.add("GET /robot-types/{robot_type}", "Get a robot type", schemas.RobotTypeOut, 404)
    async def get_robot_type(request: Request, robot_type: str) -> Response:
        """Returns joints, limits and capabilities, and the state of the newest upload."""
        caller = await auth.account(request)
        return json_response(robot_type_out(await functions.robot_types.view(caller, robot_type)))

    @routes.add("GET /robot-types/{robot_type}/archive", "Get a robot type as a zip archive", _ZIP, (404, 409))
    async def get_robot_type_archive(request: Request, robot_type: str) -> Response:
        """Returns the folder of the active version, with the same structure as under ``robots/``."""
        caller = await auth.account(request)
        return content(await functions.robot_types.archive(caller, robot_type), _ZIP, f"{robot_type}.zip")

    @routes.add("GET /robot-types/{robot_type}/files/{name:path}", "Get a file of a robot type", _BYTES, (404, 409))
    async def get_robot_type_file(request: Request, robot_type: str, name: str) -> Response:
        """Returns a file of the active version. ``robot.toml`` is the manifest."""
        caller = await auth.account(request)
        body = await functions.robot_types.file(caller, robot_type, name)
        return content(body, _BYTES, name.rpartition("/")[2])

    @routes.add(
        "GET /robot-types/{robot_type}/twin", "Get the geometry of a robot type", schemas.RobotTypeTwin, (404, 409)
    )
    async def get_robot_type_twin(request: Request, robot_type: str) -> Response:
        """Returns the geometry and joints of the active version, for 3D views without a robot."""
        return json_response(twin_out(await functions.robot_types.model(await auth.account(request), robot_type)))

    @routes.add("DELETE /robot-types/{robot_type}", "Delete a robot type", None, (404, 409))
    async def delete_robot_type(request: Request, robot_type: str) -> Response:
        """Deletes all versions. 409: a device or movement of the account uses the robot type."""
        await functions.delete_robot_type.delete(await auth.account(request), robot_type)
        return empty()

    return routes
