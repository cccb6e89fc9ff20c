"""Robot type previews: validated uploads that are not saved."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read, read_or
from function_app.entrypoints.http.framework.routing import PREFIX, Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.entrypoints.http.robot_types.serializers import preview_out, robot_type_out, twin_out


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("robot types")

    @routes.add(
        "POST /robot-type-previews",
        "Create a robot type preview",
        {201: schemas.RobotTypePreviewOut, 202: schemas.RobotTypePreviewOut},
        (409, 507),
        body=schemas.RobotTypePreviewRequest,
    )
    async def add_robot_type_preview(request: Request) -> Response:
        """Validates a robot type like an upload, without saving it. 201: validated; 202: not finished, poll it.

        An account can have four previews. Each expires after 30 min.
        """
        caller = await auth.account(request)
        payload: schemas.RobotTypePreviewRequest = await read(
            request, schemas.RobotTypePreviewRequest, limit=schemas.MAX_UPLOAD
        )
        result = await functions.robot_type_preview.begin(
            caller, payload.manifest, payload.files, payload.movements, wait_ms=payload.wait_ms
        )
        status = 202 if result.upload.open else 201
        return json_response(preview_out(result), status, {"Location": f"{PREFIX}/robot-type-previews/{result.id}"})

    @routes.add("GET /robot-type-previews/{preview}", "Get a preview", schemas.RobotTypePreviewOut, 404)
    async def get_robot_type_preview(request: Request, preview: str) -> Response:
        """Returns a preview of the account."""
        return json_response(preview_out(await functions.robot_type_preview.get(await auth.account(request), preview)))

    @routes.add(
        "GET /robot-type-previews/{preview}/twin",
        "Get the geometry of a preview",
        schemas.RobotTypeTwin,
        (404, 409, 422),
    )
    async def get_robot_type_preview_twin(request: Request, preview: str) -> Response:
        """Returns the same as for a robot type."""
        return json_response(twin_out(await functions.robot_type_preview.model(await auth.account(request), preview)))

    @routes.add(
        "POST /robot-type-previews/{preview}/save",
        "Save a preview as a robot type",
        {200: schemas.RobotTypeOut, 201: schemas.RobotTypeOut, 202: schemas.RobotTypeOut},
        (404, 409, 413, 507),
        optional_body=schemas.SaveRobotTypePreviewRequest,
    )
    async def save_robot_type_preview(request: Request, preview: str) -> Response:
        """Creates a robot type, or its next version, like an upload. Deletes the preview."""
        caller = await auth.account(request)
        payload = await read_or(request, schemas.SaveRobotTypePreviewRequest, schemas.SaveRobotTypePreviewRequest())
        view, created = await functions.robot_type_preview.save(caller, preview, wait_ms=payload.wait_ms)
        status = 201 if created else 200
        if view.upload is not None and view.upload.open:
            status = 202
        return json_response(robot_type_out(view), status, {"Location": f"{PREFIX}/robot-types/{view.manifest.type}"})

    @routes.add("DELETE /robot-type-previews/{preview}", "Delete a preview", None, 404)
    async def delete_robot_type_preview(request: Request, preview: str) -> Response:
        """Deletes a preview and its files."""
        await functions.robot_type_preview.drop(await auth.account(request), preview)
        return empty()

    return routes
