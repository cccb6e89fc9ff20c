"""Robot type and movements of a device, from its owner's library."""

from fastapi import Request, Response

from device_agent.protocol.security import signing
from function_app.bootstrap import Functions
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import content, json_response
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.entrypoints.http.robot_types.schemas import RobotTypeOut
from function_app.entrypoints.http.robot_types.serializers import movement_out, movement_source_out, robot_type_out
from function_app.services.devices.device_access import require_operator


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("devices")

    @routes.add("GET /devices/{device}/robot-type", "Get a device's robot type", RobotTypeOut, 404)
    async def get_device_robot_type(request: Request, device: str) -> Response:
        """Returns the robot type of the device's owner. The caller's own robot type with the same name may differ."""
        target = await functions.devices.get(await auth.account(request), device)
        return json_response(robot_type_out(await functions.robot_types.view(_owner(target.owner), target.robot_type)))

    @routes.add(
        "GET /devices/{device}/robot-type/files/{name:path}",
        "Get a file of a device's robot type",
        "application/octet-stream",
        (404, 409),
    )
    async def get_device_robot_type_file(request: Request, device: str, name: str) -> Response:
        """Returns a file of the active version. ``robot.toml`` is the manifest."""
        target = await functions.devices.get(await auth.account(request), device)
        body = await functions.robot_types.file(_owner(target.owner), target.robot_type, name)
        return content(body, "application/octet-stream", name.rpartition("/")[2])

    @routes.add(
        "GET /devices/{device}/movements", "List movements for a device", schemas.MovementList, (403, 404, 409, 422)
    )
    async def list_device_movements(
        request: Request, device: str, cursor: Cursor = None, limit: Limit = 100
    ) -> Response:
        """Returns built-in movements and those of the device's owner, by name. Operators only."""
        target = require_operator(await functions.devices.get(await auth.account(request), device))
        items, next_cursor = await functions.movements.list(
            _owner(target.owner), target.robot_type, cursor=cursor, limit=limit
        )
        return json_response(schemas.MovementList(items=tuple(map(movement_out, items)), cursor=next_cursor))

    @routes.add(
        "GET /devices/{device}/movements/{name}",
        "Get a movement for a device, with its source",
        schemas.MovementSource,
        (403, 404, 409),
    )
    async def get_device_movement(request: Request, device: str, name: str) -> Response:
        """Returns the newest version. Operators only."""
        target = require_operator(await functions.devices.get(await auth.account(request), device))
        movement, source = await functions.movements.get(_owner(target.owner), target.robot_type, name)
        public = signing.public_text((await functions.keys.public())[movement.key])
        return json_response(movement_source_out(target.robot_type, movement, source, public))

    return routes


def _owner(account: str) -> Identity:
    """The identity of the library's account. The caller of this function must have checked the access."""
    return Identity(account, "", "")
