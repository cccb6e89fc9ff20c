"""Spans of HTTP requests whose client sends the header ``traceparent`` of W3C Trace Context."""

from typing import Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from device_agent.protocol.fields import trace_id
from function_app.ports.monitoring import Tracing

TRACE_ID: Final = "telescope.trace_id"
"""Key of the trace id in the scope of a traced request."""
_FIRST_FAILURE = 500


class TracedRequests:
    """Middleware that records a span for each request with a valid ``traceparent``; other requests pass unchanged."""

    def __init__(self, app: ASGIApp, *, tracing: Tracing) -> None:
        self._app = app
        self._tracing = tracing

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See ``ASGIApp``."""
        traceparent = _traceparent(scope) if scope["type"] == "http" else ""
        trace = trace_id(traceparent)
        if not trace:
            await self._app(scope, receive, send)
            return
        scope[TRACE_ID] = trace
        with self._tracing.remote(scope["method"], traceparent) as span:

            async def sending(message: Message) -> None:
                if message["type"] == "http.response.start":
                    route, status = scope.get("route"), message["status"]
                    attributes = {"http.request.method": scope["method"], "http.response.status_code": status}
                    if route is not None:
                        attributes["http.route"] = route.path
                    name = scope["method"] if route is None else f"{scope['method']} {route.path}"
                    span.describe(name, attributes, failed=status >= _FIRST_FAILURE)
                await send(message)

            await self._app(scope, receive, sending)


def _traceparent(scope: Scope) -> str:
    """The header; empty without one, or with more than one."""
    values = [value for name, value in scope["headers"] if name == b"traceparent"]
    return values[0].decode("latin-1") if len(values) == 1 else ""
