"""Azure Functions: a catch-all HTTP route to the ASGI application, the timer, device messages, broker authentication.

The route is native and calls the ASGI middleware, because the framework's ASGI app breaks a route prefix. The services
are built at the first request, because a worker also imports this file to index it.
"""

import functools
import json

import azure.functions as func

from function_app import bootstrap, settings
from function_app.bootstrap import Functions
from function_app.entrypoints.http import create_app
from function_app.entrypoints.ingest.cloud_events import from_event_grid

app = func.FunctionApp(http_auth_level=func.AuthLevel.ANONYMOUS)
_TIMER_MS = 5_000
_METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE", "HEAD", "OPTIONS")


@functools.cache
def _functions() -> Functions:
    return bootstrap.build(settings.read())


@functools.cache
def _http() -> func.AsgiMiddleware:
    return func.AsgiMiddleware(create_app(_functions()))  # type: ignore[no-untyped-call]


@app.function_name("admission")
@app.route(route="eventgrid/admission", methods=["POST"])
async def admission(req: func.HttpRequest) -> func.HttpResponse:
    """The authentication webhook of an Event Grid namespace. Azure prefers it to the catch-all route."""
    from function_app.entrypoints.broker_auth.event_grid import admit  # noqa: PLC0415 (only with Event Grid as broker)

    status, decision = await admit(_functions(), req.headers.get("Authorization", ""), req.get_body())
    return func.HttpResponse(json.dumps(decision), status_code=status, mimetype="application/json")


@app.function_name("http")
@app.route(route="{*path}", methods=list(_METHODS))
async def http(req: func.HttpRequest, context: func.Context) -> func.HttpResponse:
    """Every HTTP request. The application authenticates it, not the host."""
    response: func.HttpResponse = await _http().handle_async(req, context)
    return response


@app.function_name("sweep")
@app.timer_trigger(schedule="*/5 * * * * *", arg_name="timer", run_on_startup=False)
async def sweep(timer: func.TimerRequest) -> None:  # noqa: ARG001 (the host passes it by name)
    """Run due jobs: republished commands, ended actions, expired permissions."""
    await _functions().scheduler.run_due_jobs()
    await _functions().heartbeats.timer_ran(period_ms=_TIMER_MS)


@app.function_name("ingest")
@app.event_grid_trigger(arg_name="event")
async def ingest(event: str) -> None:
    """One MQTT message routed by the Event Grid namespace. After an error Event Grid delivers it again."""
    # As text: the binding's CloudEvent class treats ``data_base64`` as an attribute, not as the payload.
    await from_event_grid(_functions(), [json.loads(event)])
