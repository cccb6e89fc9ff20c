"""Enrolment, claim and unpairing of agents."""

from typing import Annotated

import msgspec
from fastapi import Query, Request, Response

from device_agent.protocol.security import signing
from function_app.bootstrap import Functions
from function_app.domain.common.ids import format_claim_code
from function_app.domain.common.problems import invalid
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.devices import Agent, DeviceSpec
from function_app.entrypoints.http.devices.serializers import device_out
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.client_address import client_address
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.entrypoints.http.pairing import schemas
from function_app.services.pairing.enroll import Enrollment

Wait = Annotated[int, Query(ge=0, le=30_000, description="Maximum time to wait for the claim [ms].")]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("agents")

    @routes.add(
        "POST /agents/enroll",
        "Enrol an agent",
        {200: schemas.EnrollmentOut, 201: schemas.EnrollmentOut},
        409,
        body=schemas.EnrollRequest,
        caller="agent",
    )
    async def enroll_agent(request: Request) -> Response:
        """Called by an agent. Returns a claim code until an account claims the agent.

        The bearer token must be signed by the key in the body.
        """
        payload: schemas.EnrollRequest = await read(request, schemas.EnrollRequest)
        if len({device.name for device in payload.devices}) != len(payload.devices):
            raise invalid("Two devices have the same name.")
        agent = await auth.enrolling(request, payload.public_key)
        specs = tuple(msgspec.convert(device, DeviceSpec, from_attributes=True) for device in payload.devices)
        enrollment = Enrollment(
            payload.name,
            payload.public_key,
            payload.software,
            specs,
            payload.transport,
            payload.protocol,
            payload.capabilities,
        )
        done = await functions.enroll.enroll(agent, enrollment)
        if done.claimed:
            return json_response(schemas.EnrollmentOut(agent=done.id, claim_code=None, expires_at=None, expires_in_s=0))
        left_ms = max(0, done.claim_expires_ms - functions.clock.now_ms())
        body = schemas.EnrollmentOut(
            agent=done.id,
            claim_code=format_claim_code(done.claim_code),
            expires_at=rfc3339(done.claim_expires_ms),
            expires_in_s=left_ms // 1000,
        )
        return json_response(body, 201)

    @routes.add("GET /agents/enrollment", "Get the enrolment state", schemas.EnrollmentState, 422, caller="agent")
    async def enrollment(request: Request, wait_ms: Wait = 0) -> Response:
        """Called by an agent. Returns its space, its owner, and the keys whose commands it must accept."""
        agent = await functions.enroll.wait(await auth.agent(request), wait_ms)
        keys = await functions.keys.announcement()
        body = schemas.EnrollmentState(
            agent=agent.id,
            state="claimed" if agent.claimed else "waiting",
            space=agent.space,
            account=await _account(functions, agent),
            keys=tuple(
                schemas.SigningKeyOut(
                    id=pin.id, public=signing.public_text(pin.key), serial=pin.serial, until_ms=pin.until_ms
                )
                for pin in keys.pins
            ),
            key_statements=keys.statements,
            signing_key=keys.signing,
        )
        return json_response(body)

    @routes.add(
        "POST /agents/certificate",
        "Issue a broker certificate",
        schemas.CertificateOut,
        409,
        body=schemas.CertificateRequest,
        caller="agent",
    )
    async def certify(request: Request) -> Response:
        """Called by an agent whose broker requires certificates. Unpairing revokes the certificate."""
        agent = await auth.agent(request)
        payload: schemas.CertificateRequest = await read(request, schemas.CertificateRequest)
        issued = await functions.agent_certificates.certify(agent, payload.request)
        return json_response(schemas.CertificateOut(chain=issued.chain, expires_at=rfc3339(issued.expires_ms)))

    @routes.add(
        "POST /agents/claim", "Claim an agent by its code", schemas.ClaimOut, (404, 429), body=schemas.ClaimRequest
    )
    async def claim_agent(request: Request) -> Response:
        """Claims the agent for the account. Wrong, used and expired codes cause the same response."""
        caller = await auth.account(request)
        payload: schemas.ClaimRequest = await read(request, schemas.ClaimRequest)
        agent = await functions.claim.claim(
            caller, payload.code, payload.space, address=client_address(request, functions.settings.trusted_proxies)
        )
        views = await functions.devices.of_agent(caller, agent.id)
        devices = tuple(device_out(functions, view, caller) for view in views)
        return json_response(schemas.ClaimOut(agent=agent.id, space=agent.space or "", devices=devices))

    @routes.add("GET /agents", "List agents", schemas.AgentList, 422)
    async def list_agents(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Returns agents that the account has claimed."""
        caller = await auth.account(request)
        agents, next_cursor = await functions.devices.agents(caller, cursor=cursor, limit=limit)
        items = tuple(_agent_out(agent) for agent in agents)
        return json_response(schemas.AgentList(items=items, cursor=next_cursor))

    @routes.add(
        "PUT /agents/{agent}/space",
        "Move an agent to another space",
        schemas.AgentOut,
        404,
        body=schemas.MoveAgentRequest,
    )
    async def move_agent(request: Request, agent: str) -> Response:
        """Ends running actions, revokes leases and closes its broker connection. Its history stays available."""
        caller = await auth.account(request)
        payload: schemas.MoveAgentRequest = await read(request, schemas.MoveAgentRequest)
        return json_response(_agent_out(await functions.unpair.move(caller, agent, payload.space)))

    @routes.add("DELETE /agents/{agent}", "Unpair an agent", None, 404)
    async def unpair_agent(request: Request, agent: str) -> Response:
        """Removes its devices, closes its broker connection, and makes it claimable again."""
        await functions.unpair.unpair(await auth.account(request), agent)
        return empty()

    return routes


def _agent_out(agent: Agent) -> schemas.AgentOut:
    return schemas.AgentOut(
        id=agent.id,
        name=agent.name,
        software=agent.software,
        space=agent.space or "",
        transport=agent.transport,
        devices=tuple(spec.name for spec in agent.devices),
        claimed_at=rfc3339(agent.claimed_ms),
    )


async def _account(functions: Functions, agent: Agent) -> AccountRef | None:
    if agent.account is None:
        return None
    return AccountRef(id=agent.account, name=await functions.sign_in.named(agent.account))
