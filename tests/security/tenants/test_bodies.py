"""Every route enforces its body limit while it reads the body."""

from collections.abc import AsyncIterator
from typing import Any

import httpx

from function_app.entrypoints.http.framework.responses import MAX_BODY
from function_app.entrypoints.http.robot_types.schemas import MAX_UPLOAD
from tests.harness.cloud.cloud import API, problem
from tests.security.tenants.test_routes import send_request
from tests.security.tenants.world import World

PART = 65_536
LARGER = {"add_robot_type": MAX_UPLOAD, "add_robot_type_preview": MAX_UPLOAD}
"""Routes with a larger limit than the default."""
PAGE_ONLY = {"renew_token"}
"""Routes that need the cookie of a page, which no caller here has. They are rejected before they read the body."""


class Endless:
    """A body without a declared length that continues until the server stops reading."""

    def __init__(self, most: int) -> None:
        self.taken = 0
        self._most = most

    async def parts(self) -> AsyncIterator[bytes]:
        while True:
            self.taken += PART
            assert self.taken < self._most + 10 * PART, "the server read the complete body"
            yield b" " * PART


def operations(world: World) -> list[tuple[str, str, str, dict[str, Any]]]:
    return [
        (str(operation["operationId"]), method.upper(), path.removeprefix("/api/v1"), operation)
        for path, methods in world.cloud.app.openapi()["paths"].items()
        for method, operation in methods.items()
    ]


def caller(operation: dict[str, Any]) -> str:
    """Role that may send the request."""
    names = {name for need in operation["security"] for name in need}
    if not names:
        return "anonymous"
    return "owner" if "accessToken" in names else "agent"


def send_body(world: World, name: str, method: str, path: str, role: str, **body: Any) -> Any:
    """Response to this body instead of the default one."""
    robot: Any = getattr(world.callers["agent"], "__self__", None)
    if role == "agent":
        body["headers"] = {"Authorization": f"Bearer {robot.token()}", **body.get("headers", {})}

    def send(method: str, path: str, **_: Any) -> httpx.Response:
        return (
            world.cloud.request(method, API + path, **body)
            if role == "agent"
            else world.callers[role](method, path, **body)
        )

    return send_request(World(world.cloud, {role: send}, world.ids, {}), role, name, method, path)[1]


def test_every_route_rejects_a_body_that_is_too_large_without_reading_it(world: World) -> None:
    seen = 0
    for name, method, path, operation in operations(world):
        if "requestBody" not in operation:
            continue
        assert "413" in operation["responses"], name
        limit, role = LARGER.get(name, MAX_BODY), caller(operation)
        body = Endless(limit)
        if name in PAGE_ONLY:
            problem(send_body(world, name, method, path, role, content=body.parts()), 401, "unauthorized")
            assert body.taken == 0, f"{name} took {body.taken} bytes"
            continue
        problem(send_body(world, name, method, path, role, content=body.parts()), 413, "too-large")
        assert limit < body.taken <= limit + 2 * PART, f"{name} took {body.taken} bytes"
        body = Endless(limit)
        declared = {"headers": {"Content-Length": str(limit + 1)}}
        problem(send_body(world, name, method, path, role, content=body.parts(), **declared), 413, "too-large")
        assert body.taken == 0, f"{name} took {body.taken} bytes although Content-Length was too large"
        world.restore()
        seen += 1
    print(f"{seen} routes with a body")  # noqa: T201
    assert seen > 30


def test_routes_without_a_body_read_none(world: World) -> None:
    for name, method, path, operation in operations(world):
        if "requestBody" in operation:
            continue
        body = Endless(0)
        send_body(world, name, method, path, caller(operation), content=body.parts())
        assert body.taken == 0, f"{name} took {body.taken} bytes"
        world.restore()
