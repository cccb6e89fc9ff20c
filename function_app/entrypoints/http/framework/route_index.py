"""Route lookup by path segments, independent of the number of routes."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from fastapi.routing import APIRoute
from starlette.routing import BaseRoute, Match
from starlette.types import Receive, Scope, Send


@dataclass(slots=True)
class _Node:
    """One path segment: routes that end here, and the next segments."""

    literals: dict[str, "_Node"] = field(default_factory=dict)
    parameter: "_Node | None" = None
    complete: list[int] = field(default_factory=list)
    open_ended: list[int] = field(default_factory=list)
    """Routes whose last parameter matches the rest of the path (``{name:path}``)."""


class RouteIndex(BaseRoute):
    """Selects the route of a request in one pass over the path segments.

    The result equals a sequential search: the first route that matches path and method, otherwise the first that
    matches the path (405).
    """

    def __init__(self, routes: Iterable[APIRoute]) -> None:
        self.routes = tuple(routes)
        self._root = _Node()
        for number, route in enumerate(self.routes):
            self._insert(number, route.path)

    def _insert(self, number: int, path: str) -> None:
        node = self._root
        for segment in path.split("/"):
            if not segment.startswith("{"):
                node = node.literals.setdefault(segment, _Node())
            elif segment.endswith(":path}"):
                node.open_ended.append(number)
                return
            else:
                node.parameter = node.parameter or _Node()
                node = node.parameter
        node.complete.append(number)

    def on_path(self, scope: Scope) -> list[APIRoute]:
        """Routes for the request's path, of any method, in the order of registration."""
        path: str = scope["path"]
        root: str = scope.get("root_path", "")
        if root and path.startswith(root + "/"):
            path = path[len(root) :]
        numbers: list[int] = []
        nodes = [self._root]
        for segment in path.split("/"):
            following: list[_Node] = []
            for node in nodes:
                numbers += node.open_ended
                if segment in node.literals:
                    following.append(node.literals[segment])
                if segment and node.parameter is not None:
                    following.append(node.parameter)
            nodes = following
        for node in nodes:
            numbers += node.complete
        return [self.routes[number] for number in sorted(numbers)]

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """The match of the selected route. Its scope names that route."""
        if scope["type"] != "http":
            return Match.NONE, {}
        candidates = self.on_path(scope)
        selected = next((route for route in candidates if scope["method"] in (route.methods or ())), None)
        selected = selected or next(iter(candidates), None)
        return (Match.NONE, {}) if selected is None else selected.matches(scope)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request to the selected route."""
        await scope["route"].handle(scope, receive, send)
