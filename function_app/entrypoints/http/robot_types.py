"""``robot-types``."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http import show
from function_app.entrypoints.http.answers import answer
from function_app.entrypoints.http.caller import Caller
from function_app.entrypoints.http.contract import robot_types as contract
from function_app.entrypoints.http.routing import Routes


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("robot types")

    @routes.add("GET", "/robot-types", summary="Robot types", answers={200: contract.RobotTypeList})
    async def list_robot_types(request: Request) -> Response:
        """Those that come with the installation."""
        who = await caller.account(request)
        items = tuple(show.robot_type(found) for found in await functions.robot_types.list(who))
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
        who = await caller.account(request)
        return answer(show.robot_type(await functions.robot_types.get(who, robot_type)))

    return routes
