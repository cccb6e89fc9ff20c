"""``robot-type-previews``: a robot type before it is saved."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, empty, read, read_or
from function_app.entrypoints.http.framework.routing import PREFIX, Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.entrypoints.http.robot_types.serializers import preview_out, robot_type_out, twin_out

_ONE = "/robot-type-previews/{preview}"


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("robot types")

    @routes.add(
        "POST",
        "/robot-type-previews",
        summary="Look at a robot type before it is saved",
        body=schemas.RobotTypePreviewRequest,
        answers={201: schemas.RobotTypePreviewOut, 202: schemas.RobotTypePreviewOut},
        problems=(409,),
    )
    async def add_robot_type_preview(request: Request) -> Response:
        """Compiled and compared with its manifest as an upload is. 201: there is a verdict; 202: look at it again.

        Four of an account are kept, each for half an hour.
        """
        who = await caller.account(request)
        asked: schemas.RobotTypePreviewRequest = await read(
            request, schemas.RobotTypePreviewRequest, limit=schemas.MAX_UPLOAD
        )
        found = await functions.robot_type_preview.begin(
            who, asked.manifest, asked.files, asked.movements, wait_ms=asked.wait_ms
        )
        status = 202 if found.upload.open else 201
        return answer(preview_out(found), status, {"Location": f"{PREFIX}/robot-type-previews/{found.id}"})

    @routes.add("GET", _ONE, summary="How a look fares", answers={200: schemas.RobotTypePreviewOut}, problems=(404,))
    async def get_robot_type_preview(request: Request, preview: str) -> Response:
        """One's own."""
        return answer(preview_out(await functions.robot_type_preview.get(await caller.account(request), preview)))

    @routes.add(
        "GET",
        _ONE + "/twin",
        summary="The drawing of what is looked at",
        answers={200: schemas.RobotTypeTwin},
        problems=(404, 409, 422),
    )
    async def get_robot_type_preview_twin(request: Request, preview: str) -> Response:
        """As of a robot type."""
        return answer(twin_out(await functions.robot_type_preview.model(await caller.account(request), preview)))

    @routes.add(
        "POST",
        _ONE + "/save",
        summary="Save what is looked at",
        body=schemas.SaveRobotTypePreviewRequest,
        body_required=False,
        answers={200: schemas.RobotTypeOut, 201: schemas.RobotTypeOut, 202: schemas.RobotTypeOut},
        problems=(404, 409),
    )
    async def save_robot_type_preview(request: Request, preview: str) -> Response:
        """It becomes a robot type, or the next version of one, as if it were uploaded now; the look ends."""
        who = await caller.account(request)
        asked = await read_or(request, schemas.SaveRobotTypePreviewRequest, schemas.SaveRobotTypePreviewRequest())
        found, new = await functions.robot_type_preview.save(who, preview, wait_ms=asked.wait_ms)
        status = 201 if new else 200
        if found.upload is not None and found.upload.open:
            status = 202
        return answer(robot_type_out(found), status, {"Location": f"{PREFIX}/robot-types/{found.manifest.type}"})

    @routes.add("DELETE", _ONE, summary="End a look", answers={204: None}, problems=(404,))
    async def delete_robot_type_preview(request: Request, preview: str) -> Response:
        """What it has stored goes."""
        await functions.robot_type_preview.drop(await caller.account(request), preview)
        return empty()

    return routes
