"""AWS Lambda: one handler for HTTP, device messages, broker authentication and the timer.

The first event creates the services and the event loop of their connections. Both are reused until the instance ends.
The loop runs only during an invocation; between invocations the instance is frozen, for milliseconds or for an hour.
"""

import asyncio
import functools
from typing import TYPE_CHECKING, Any

from function_app import bootstrap, settings
from function_app.bootstrap import Functions
from function_app.entrypoints.broker_auth.iot_core import authorise
from function_app.entrypoints.http import create_app
from function_app.entrypoints.ingest.cloud_events import from_iot_rule, from_queue

if TYPE_CHECKING:
    from mangum import Mangum

_SCHEDULES = frozenset({"aws.events", "aws.scheduler"})
"""Sources of timer events from EventBridge rules and schedules without custom input."""
_TEXT = ("text/", "application/json", "application/problem+json", "application/javascript", "image/svg+xml")
"""Content types that are returned as text; the gateway requires base64 for all others."""
_TIMER_MS = 60_000
"""Shortest period of an EventBridge schedule [ms]."""
_MAX_LOGGED = 200


def handler(event: dict[str, Any], context: Any) -> Any:
    """Handle one invocation. After an error the gateway responds with 500, or AWS delivers the event again.

    Raises:
        ValueError: The event has an unknown type.
    """
    loop = _loop()
    if "requestContext" in event:
        return _http()(event, context)
    if "protocolData" in event:
        return loop.run_until_complete(authorise(_functions(), event, context.invoked_function_arn))
    if "Records" in event:
        return loop.run_until_complete(from_queue(_functions(), event))
    if "topic" in event:
        return loop.run_until_complete(from_iot_rule(_functions(), event))
    if event.get("source") in _SCHEDULES:
        return loop.run_until_complete(_run_timer())
    raise ValueError(f"unknown event with the fields {str(sorted(event))[:_MAX_LOGGED]}")


async def _run_timer() -> None:
    await _functions().scheduler.run_due_jobs()
    await _functions().heartbeats.timer_ran(period_ms=_TIMER_MS)


@functools.cache
def _loop() -> asyncio.AbstractEventLoop:
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)  # Mangum uses the current loop
    return loop


@functools.cache
def _functions() -> Functions:
    return bootstrap.build(settings.read())


@functools.cache
def _http() -> "Mangum":
    from mangum import Mangum  # noqa: PLC0415 (only for HTTP events)

    return Mangum(create_app(_functions()), lifespan="off", text_mime_types=list(_TEXT))
