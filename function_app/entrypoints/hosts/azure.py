"""Azure Functions: a catch-all HTTP route to the ASGI application, the timer, what devices say, and who may connect.

A native route with the ASGI middleware inside, because the framework's own ASGI app breaks a route prefix; built at the
first request, because a worker imports this file to index it.
"""

import functools
import json

import azure.functions as func

from function_app import bootstrap, settings
from function_app.bootstrap import Functions
from function_app.entrypoints.http import create_app
from function_app.entrypoints.ingest.cloud_events import from_event_grid

app = func.FunctionApp(http_auth_level=func.AuthLevel.ANONYMOUS)
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
    """Where an Event Grid namespace asks who may connect. Azure prefers this route to the one that takes everything."""
    from function_app.entrypoints.broker_auth.event_grid import admit  # noqa: PLC0415 (only where Event Grid is the broker)

    status, answer = await admit(_functions(), req.headers.get("Authorization", ""), req.get_body())
    return func.HttpResponse(json.dumps(answer), status_code=status, mimetype="application/json")


@app.function_name("http")
@app.route(route="{*path}", methods=list(_METHODS))
async def http(req: func.HttpRequest, context: func.Context) -> func.HttpResponse:
    """Every HTTP request. Our own tokens decide who may do what."""
    answer: func.HttpResponse = await _http().handle_async(req, context)
    return answer


@app.function_name("sweep")
@app.timer_trigger(schedule="*/5 * * * * *", arg_name="timer", run_on_startup=False)
async def sweep(timer: func.TimerRequest) -> None:  # noqa: ARG001 (the host passes it by name)
    """What time brings: commands sent again, actions ended, rights expired."""
    await _functions().scheduler.run_due_jobs()


@app.function_name("ingest")
@app.event_grid_trigger(arg_name="event")
async def ingest(event: str) -> None:
    """One MQTT message that the Event Grid namespace has routed. An error makes Event Grid deliver it again."""
    # As text: the binding's own class for CloudEvents takes a payload in ``data_base64`` for an attribute.
    await from_event_grid(_functions(), [json.loads(event)])
