"""``robot-types``."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, content, empty, read
from function_app.entrypoints.http.framework.routing import PREFIX, Cursor, Limit, Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.entrypoints.http.robot_types.serializers import robot_type_out, twin_out

_ONE = "/robot-types/{robot_type}"
_BYTES = "application/octet-stream"
_ZIP = "application/zip"


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("robot types")

    @routes.add("GET", "/robot-types", summary="Robot types", answers={200: schemas.RobotTypeList}, problems=(422,))
    async def list_robot_types(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Those that come with the installation, and the account's own."""
        who = await caller.account(request)
        found, following = await functions.robot_types.list(who, cursor=cursor, limit=limit)
        return answer(schemas.RobotTypeList(items=tuple(map(robot_type_out, found)), cursor=following))

    @routes.add(
        "POST",
        "/robot-types",
        summary="Add a robot type, or the next version of one",
        body=schemas.RobotTypeRequest,
        answers={200: schemas.RobotTypeOut, 201: schemas.RobotTypeOut, 202: schemas.RobotTypeOut},
        problems=(404, 409),
    )
    async def add_robot_type(request: Request) -> Response:
        """MuJoCo compiles it and compares it with the manifest. 201 and 200: it is ready, new or the next version.

        202: no verdict yet; look at it again. 422 ``robot-type-rejected``: ``errors`` says what is wrong.
        """
        who = await caller.account(request)
        asked: schemas.RobotTypeRequest = await read(request, schemas.RobotTypeRequest, limit=schemas.MAX_UPLOAD)
        found, new = await functions.upload_robot_type.upload(who, asked.manifest, asked.files, wait_ms=asked.wait_ms)
        status = 201 if new else 200
        if found.upload is not None and found.upload.open:
            status = 202
        where = {"Location": f"{PREFIX}/robot-types/{found.manifest.type}"}
        return answer(robot_type_out(found), status, where)

    @routes.add("GET", _ONE, summary="One robot type", answers={200: schemas.RobotTypeOut}, problems=(404,))
    async def get_robot_type(request: Request, robot_type: str) -> Response:
        """Joints, limits and capabilities; and how its newest upload fares."""
        who = await caller.account(request)
        return answer(robot_type_out(await functions.robot_types.view(who, robot_type)))

    @routes.add(
        "GET", _ONE + "/archive", summary="All files of a robot type as a zip", answers={200: _ZIP}, problems=(404, 409)
    )
    async def get_robot_type_archive(request: Request, robot_type: str) -> Response:
        """A folder as under ``robots/``, of the version in use."""
        who = await caller.account(request)
        return content(await functions.robot_types.archive(who, robot_type), _ZIP, f"{robot_type}.zip")

    @routes.add(
        "GET",
        _ONE + "/files/{name:path}",
        summary="One file of a robot type",
        answers={200: _BYTES},
        problems=(404, 409),
    )
    async def get_robot_type_file(request: Request, robot_type: str, name: str) -> Response:
        """Of the version in use; ``robot.toml`` is the manifest."""
        who = await caller.account(request)
        body = await functions.robot_types.file(who, robot_type, name)
        return content(body, _BYTES, name.rpartition("/")[2])

    @routes.add(
        "GET",
        _ONE + "/twin",
        summary="The drawing of a robot type",
        answers={200: schemas.RobotTypeTwin},
        problems=(404, 409),
    )
    async def get_robot_type_twin(request: Request, robot_type: str) -> Response:
        """What a page needs to show and move the version in use, where there is no robot of it."""
        return answer(twin_out(await functions.robot_types.model(await caller.account(request), robot_type)))

    @routes.add("DELETE", _ONE, summary="Delete a robot type of one's own", answers={204: None}, problems=(404, 409))
    async def delete_robot_type(request: Request, robot_type: str) -> Response:
        """All its versions, unless a device or a movement of the account needs it."""
        await functions.delete_robot_type.delete(await caller.account(request), robot_type)
        return empty()

    return routes
