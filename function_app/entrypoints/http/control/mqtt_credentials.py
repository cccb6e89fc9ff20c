"""MQTT credentials."""

from typing import Any

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.devices import Agent
from function_app.entrypoints.http.control import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.control.mqtt_credentials import IssuedCredentials


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("broker")

    @routes.add(
        "POST /mqtt/credentials",
        "Get MQTT credentials",
        schemas.MqttCredentialsOut,
        (404, 409),
        body=schemas.MqttCredentialsRequest,
        caller="account or agent",
    )
    async def mqtt_credentials(request: Request) -> Response:
        """Returns short-lived credentials for viewing, for setpoints under a lease, or for an agent's own devices."""
        payload: Any = await read(request, schemas.MqttCredentialsRequest)
        agent = await auth.agent(request) if isinstance(payload, schemas.AgentCredentialsRequest) else None
        issued = await _issue(request, payload, agent)
        certificate_after_ms = agent.claimed_ms if agent is not None and functions.certificates.required else None
        settings = functions.settings
        keys = await functions.keys.announcement() if agent is not None else None
        body = schemas.MqttCredentialsOut(
            client_id=issued.client_id,
            username=issued.credentials.username,
            password=issued.credentials.password,
            expires_at=rfc3339(issued.expires_ms),
            lifetime_s=issued.lifetime_s,
            publish=issued.publish,
            subscribe=issued.subscribe,
            confirmations=issued.confirmations,
            tcp=schemas.TcpAddress(
                host=settings.mqtt_host,
                port=settings.mqtt_port,
                tls=settings.tls is not None or settings.broker in {"iot", "eventgrid"},
                certificate_after_ms=certificate_after_ms,
            ),
            websocket_url=settings.websocket_url,
            server_time_ms=functions.clock.now_ms(),
            key_statements=() if keys is None else keys.statements,
            signing_key="" if keys is None else keys.signing,
        )
        return json_response(body, headers={"Cache-Control": "no-store"})

    async def _issue(request: Request, payload: Any, agent: Agent | None) -> IssuedCredentials:
        if agent is not None:
            return await functions.mqtt_credentials.agent(agent)
        caller = await auth.account(request)
        if isinstance(payload, schemas.ControlCredentialsRequest):
            return await functions.mqtt_credentials.control(caller, payload.device, payload.epoch)
        return await functions.mqtt_credentials.watch(caller)

    return routes
