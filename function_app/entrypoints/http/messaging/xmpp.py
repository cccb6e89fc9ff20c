"""XMPP credentials, and verification of logins for the XMPP server."""

from typing import Any

import msgspec
from fastapi import Request, Response

from device_agent.protocol.xmpp import jids
from function_app.bootstrap import Functions
from function_app.domain.common.problems import forbidden
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.control.schemas import AgentCredentialsRequest, ControlCredentialsRequest
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator, bearer
from function_app.entrypoints.http.framework.responses import json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.messaging import schemas

_NO_STORE = {"Cache-Control": "no-store"}


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("broker")

    @routes.add(
        "POST /xmpp/credentials",
        "Get XMPP credentials",
        schemas.XmppCredentialsOut,
        (403, 404, 409),
        body=schemas.XmppCredentialsRequest,
        caller="account or agent",
    )
    async def xmpp_credentials(request: Request) -> Response:
        """Returns credentials for an agent with transport ``xmpp``, an XMPP client, or setpoints under a lease."""
        payload: Any = await read(request, schemas.XmppCredentialsRequest)
        space: str | None = None
        token = websocket_url = ""
        if isinstance(payload, AgentCredentialsRequest):
            agent = await auth.agent(request)
            issued = await functions.xmpp_credentials.agent(agent)
            space = agent.space
        elif isinstance(payload, ControlCredentialsRequest):
            caller = await auth.account(request)
            if bearer(request):
                raise forbidden("Only a signed-in page gets these credentials: an access token cannot renew itself.")
            await functions.mqtt_credentials.require_control(caller, payload.device, payload.epoch)
            issued, token = await functions.xmpp_credentials.browser(caller)
            websocket_url = functions.settings.xmpp.websocket_url
        else:
            issued = await functions.xmpp_credentials.account(await auth.account(request))
        settings = functions.settings
        keys = None if space is None else await functions.keys.announcement()
        body = schemas.XmppCredentialsOut(
            jid=f"{issued.user}@{settings.xmpp.domain}",
            password=issued.password,
            expires_at=rfc3339(issued.expires_ms),
            lifetime_s=issued.lifetime_s,
            space=space,
            cloud=f"{jids.CLOUD}@{settings.xmpp.domain}",
            host=settings.xmpp.host,
            port=settings.xmpp.port,
            server_time_ms=functions.clock.now_ms(),
            token=token,
            websocket_url=websocket_url,
            key_statements=() if keys is None else keys.statements,
            signing_key="" if keys is None else keys.signing,
        )
        return json_response(body, headers=_NO_STORE)

    @routes.add(
        "POST /xmpp/verify",
        "Verify an XMPP login",
        schemas.XmppIdentityOut,
        (401, 409),
        body=schemas.XmppVerifyRequest,
        caller="anonymous",
    )
    async def xmpp_verify(request: Request) -> Response:
        """Called by the XMPP server to authenticate a user. Requires a valid password."""
        payload: schemas.XmppVerifyRequest = await read(request, schemas.XmppVerifyRequest)
        identity = await functions.xmpp_credentials.verify(payload.user, payload.password)
        body = msgspec.convert(identity, schemas.XmppIdentityOut, from_attributes=True)
        return json_response(body, headers=_NO_STORE)

    return routes
