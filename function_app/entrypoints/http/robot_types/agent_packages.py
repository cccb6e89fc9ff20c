"""Robot types for agents, from the library of the account that owns the agent."""

import base64

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import not_found
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.robot_types import schemas
from function_app.services.devices.device_access import require_claimed


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("agents")

    @routes.add(
        "GET /agents/{agent}/robot-types/{robot_type}",
        "Get a robot type for an agent",
        schemas.RobotTypePackageOut,
        (404, 409),
        caller="agent",
    )
    async def get_agent_robot_type(request: Request, agent: str, robot_type: str) -> Response:
        """Returns the files of the active version, and a signed statement of their hashes.

        Only types that a device of the agent uses.
        """
        caller = await auth.agent(request)
        if caller.id != agent:
            raise not_found("agent", agent)
        require_claimed(caller)
        if robot_type not in {device.robot_type for device in caller.devices}:
            raise not_found("robot-type", robot_type)
        owner = Identity(caller.account or "", "", "")
        statement, files = await functions.robot_types.package(owner, robot_type, agent=agent)
        encoded = {name: base64.b64encode(content).decode() for name, content in files.items()}
        return json_response(schemas.RobotTypePackageOut(statement=statement.decode(), files=encoded))

    return routes
