"""``robot-types`` and their movements."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http import show
from function_app.entrypoints.http.answers import answer, empty, read
from function_app.entrypoints.http.caller import Caller
from function_app.entrypoints.http.contract import library as contract
from function_app.entrypoints.http.routing import Routes

_MOVEMENTS = "/robot-types/{robot_type}/movements"


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("robot types")

    @routes.add("GET", "/robot-types", summary="Robot types", answers={200: contract.RobotTypeList})
    async def list_robot_types(request: Request) -> Response:
        """Those that come with the installation."""
        await caller.account(request)
        items = tuple(show.robot_type(found) for found in await functions.movements.types())
        return answer(contract.RobotTypeList(items=items, cursor=None))

    @routes.add(
        "GET",
        "/robot-types/{robot_type}",
        summary="One robot type",
        answers={200: contract.RobotTypeOut},
        problems=(404,),
    )
    async def get_robot_type(request: Request, robot_type: str) -> Response:
        """Joints, limits and capabilities."""
        await caller.account(request)
        return answer(show.robot_type(await functions.movements.type(robot_type)))

    @routes.add(
        "GET", _MOVEMENTS, summary="Movements of a robot type", answers={200: contract.MovementList}, problems=(404,)
    )
    async def list_movements(request: Request, robot_type: str) -> Response:
        """Built-in ones and the account's own, by name."""
        who = await caller.account(request)
        items = tuple(show.movement(found) for found in await functions.movements.list(who, robot_type))
        return answer(contract.MovementList(items=items, cursor=None))

    @routes.add(
        "GET",
        _MOVEMENTS + "/{name}",
        summary="One movement with its source",
        answers={200: contract.MovementSource},
        problems=(404, 409),
    )
    async def get_movement(request: Request, robot_type: str, name: str) -> Response:
        """Its newest version."""
        who = await caller.account(request)
        return answer(show.movement_source(*await functions.movements.get(who, robot_type, name)))

    @routes.add(
        "PUT",
        _MOVEMENTS + "/{name}",
        summary="Save a movement",
        body=contract.MovementRequest,
        answers={200: contract.MovementOut, 201: contract.MovementOut},
        problems=(404, 409),
    )
    async def put_movement(request: Request, robot_type: str, name: str) -> Response:
        """A new version of the account's own; it shadows a built-in one of the same name."""
        who = await caller.account(request)
        asked: contract.MovementRequest = await read(request, contract.MovementRequest)
        found, new = await functions.movements.put(
            who, robot_type, name, source=asked.source, description=asked.description
        )
        return answer(show.movement(found), 201 if new else 200)

    @routes.add(
        "DELETE",
        _MOVEMENTS + "/{name}",
        summary="Delete a movement of one's own",
        answers={204: None},
        problems=(404, 409),
    )
    async def delete_movement(request: Request, robot_type: str, name: str) -> Response:
        """A built-in one of the same name shows again."""
        await functions.movements.delete(await caller.account(request), robot_type, name)
        return empty()

    return routes
