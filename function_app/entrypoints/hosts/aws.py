"""AWS Lambda: one handler for HTTP, for what devices say, for who connects to the broker, and for the timer.

The functions, and the event loop that their connections belong to, are made at the first event and live as long as the
instance. The loop only runs during an invocation: between two the instance is frozen, for milliseconds or for an hour.
"""

import asyncio
import functools
from typing import Any

from mangum import Mangum

from function_app import bootstrap, settings
from function_app.bootstrap import Functions
from function_app.entrypoints.broker_auth.iot_core import authorise
from function_app.entrypoints.http import create_app
from function_app.entrypoints.ingest.cloud_events import from_iot_rule, from_queue

_SCHEDULES = frozenset({"aws.events", "aws.scheduler"})
"""EventBridge's rules and its scheduler, where they give no input of their own."""
_TEXT = ("text/", "application/json", "application/problem+json", "application/javascript", "image/svg+xml")
"""What goes out as it is; the gateway takes everything else in base64."""
_SHOWN = 200


def handler(event: dict[str, Any], context: Any) -> Any:
    """One invocation. An error is the gateway's 500, or makes Amazon deliver the event again.

    Raises:
        ValueError: The event is none that the functions know.
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
        return loop.run_until_complete(_functions().scheduler.run_due_jobs())
    raise ValueError(f"an event with the fields {str(sorted(event))[:_SHOWN]} is for none of the functions")


@functools.cache
def _loop() -> asyncio.AbstractEventLoop:
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)  # where Mangum looks for it
    return loop


@functools.cache
def _functions() -> Functions:
    return bootstrap.build(settings.read())


@functools.cache
def _http() -> Mangum:
    return Mangum(create_app(_functions()), lifespan="off", text_mime_types=list(_TEXT))
