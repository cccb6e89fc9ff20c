"""``mqtt/credentials``."""

from typing import Any

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.devices import Agent
from function_app.entrypoints.http.control import schemas
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.control.mqtt_credentials import IssuedCredentials


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("broker")

    @routes.add(
        "POST",
        "/mqtt/credentials",
        summary="Short-lived broker credentials",
        body=schemas.MqttCredentialsRequest,
        answers={200: schemas.MqttCredentialsOut},
        problems=(404, 409),
        caller="account or agent",
    )
    async def mqtt_credentials(request: Request) -> Response:
        """For watching, for sending setpoints under a lease, or for an agent's own devices."""
        asked: Any = await read(request, schemas.MqttCredentialsRequest)
        agent = await caller.agent(request) if isinstance(asked, schemas.AgentCredentialsRequest) else None
        issued = await _issue(request, asked, agent)
        wanted = agent is not None and functions.certificates.wanted
        certificate_after_ms = agent.claimed_ms if agent is not None and wanted else None
        settings = functions.settings
        news = await functions.keys.news() if agent is not None else None
        body = schemas.MqttCredentialsOut(
            client_id=issued.client_id,
            username=issued.credentials.username,
            password=issued.credentials.password,
            expires_at=rfc3339(issued.expires_ms),
            lifetime_s=issued.lifetime_s,
            publish=issued.publish,
            subscribe=issued.subscribe,
            tcp=schemas.TcpAddress(
                host=settings.mqtt_host,
                port=settings.mqtt_port,
                tls=settings.tls is not None or settings.broker in {"iot", "eventgrid"},
                certificate_after_ms=certificate_after_ms,
            ),
            websocket_url=settings.websocket_url,
            server_time_ms=functions.clock.now_ms(),
            key_statements=() if news is None else news.statements,
            signing_key="" if news is None else news.signing,
        )
        return answer(body, headers={"Cache-Control": "no-store"})

    async def _issue(request: Request, asked: Any, agent: Agent | None) -> IssuedCredentials:
        if agent is not None:
            return await functions.mqtt_credentials.agent(agent)
        who = await caller.account(request)
        if isinstance(asked, schemas.ControlCredentialsRequest):
            return await functions.mqtt_credentials.control(who, asked.device, asked.epoch)
        return await functions.mqtt_credentials.watch(who)

    return routes
