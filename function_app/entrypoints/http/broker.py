"""``mqtt/credentials``."""

from typing import Any

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.times import rfc3339
from function_app.entrypoints.http.answers import answer, read
from function_app.entrypoints.http.caller import Caller
from function_app.entrypoints.http.contract import broker as contract
from function_app.entrypoints.http.routing import Routes
from function_app.services.mqtt_credentials import Issued


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("broker")

    @routes.add(
        "POST",
        "/mqtt/credentials",
        summary="Short-lived broker credentials",
        body=contract.MqttRequest,
        answers={200: contract.MqttCredentialsOut},
        problems=(404, 409),
        caller="account or agent",
    )
    async def mqtt_credentials(request: Request) -> Response:
        """For watching, for sending setpoints under a lease, or for an agent's own devices."""
        asked: Any = await read(request, contract.MqttRequest)
        issued = await _issue(request, asked)
        settings = functions.settings
        news = await functions.keys.news() if isinstance(asked, contract.AgentRequest) else None
        body = contract.MqttCredentialsOut(
            client_id=issued.client_id,
            username=issued.credentials.username,
            password=issued.credentials.password,
            expires_at=rfc3339(issued.expires_ms),
            lifetime_s=issued.lifetime_s,
            publish=issued.publish,
            subscribe=issued.subscribe,
            tcp=contract.TcpAddress(host=settings.mqtt_host, port=settings.mqtt_port, tls=settings.tls is not None),
            websocket_url=settings.websocket_url,
            server_time_ms=functions.clock.now_ms(),
            key_statements=() if news is None else news.statements,
            signing_key="" if news is None else news.signing,
        )
        return answer(body, headers={"Cache-Control": "no-store"})

    async def _issue(request: Request, asked: Any) -> Issued:
        if isinstance(asked, contract.AgentRequest):
            return await functions.mqtt_credentials.agent(await caller.agent(request))
        who = await caller.account(request)
        if isinstance(asked, contract.ControlRequest):
            return await functions.mqtt_credentials.control(who, asked.device, asked.epoch)
        return await functions.mqtt_credentials.watch(who)

    return routes
