"""``agents``: enrolment, claim, list, un-pairing."""

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
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.client_address import client_address
from function_app.entrypoints.http.framework.responses import answer, empty, read
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.framework.schemas import AccountRef
from function_app.entrypoints.http.pairing import schemas
from function_app.services.pairing.enroll import Enrollment

Wait = Annotated[int, Query(ge=0, le=30_000, description="Wait at most this long for the claim [ms].")]


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("agents")

    @routes.add(
        "POST",
        "/agents/enroll",
        summary="Make an agent known",
        body=schemas.EnrollRequest,
        answers={200: schemas.EnrollmentOut, 201: schemas.EnrollmentOut},
        problems=(409,),
        caller="agent",
    )
    async def enroll_agent(request: Request) -> Response:
        """Called by an agent, with a token that the key in the body signed. Gives a claim code while unclaimed."""
        asked: schemas.EnrollRequest = await read(request, schemas.EnrollRequest)
        if len({device.name for device in asked.devices}) != len(asked.devices):
            raise invalid("Two devices have the same name.")
        agent = await caller.enrolling(request, asked.public_key)
        specs = tuple(msgspec.convert(device, DeviceSpec, from_attributes=True) for device in asked.devices)
        told = Enrollment(asked.name, asked.public_key, asked.software, specs, asked.transport)
        done = await functions.enroll.enroll(agent, told)
        if done.claimed:
            return answer(schemas.EnrollmentOut(agent=done.id, claim_code=None, expires_at=None, expires_in_s=0))
        left_ms = max(0, done.claim_expires_ms - functions.clock.now_ms())
        body = schemas.EnrollmentOut(
            agent=done.id,
            claim_code=format_claim_code(done.claim_code),
            expires_at=rfc3339(done.claim_expires_ms),
            expires_in_s=left_ms // 1000,
        )
        return answer(body, 201)

    @routes.add(
        "GET",
        "/agents/enrollment",
        summary="Whether this agent is claimed",
        answers={200: schemas.EnrollmentState},
        problems=(422,),
        caller="agent",
    )
    async def enrollment(request: Request, wait_ms: Wait = 0) -> Response:
        """Called by an agent: its space, its owner, and the keys whose commands it is to obey."""
        agent = await functions.enroll.wait(await caller.agent(request), wait_ms)
        news = await functions.keys.news()
        body = schemas.EnrollmentState(
            agent=agent.id,
            state="claimed" if agent.claimed else "waiting",
            space=agent.space,
            account=await _account(functions, agent),
            keys=tuple(
                schemas.SigningKeyOut(
                    id=pin.id, public=signing.public_text(pin.key), serial=pin.serial, until_ms=pin.until_ms
                )
                for pin in news.pins
            ),
            key_statements=news.statements,
            signing_key=news.signing,
        )
        return answer(body)

    @routes.add(
        "POST",
        "/agents/certificate",
        summary="A certificate to show to the broker",
        body=schemas.CertificateRequest,
        answers={200: schemas.CertificateOut},
        problems=(409,),
        caller="agent",
    )
    async def certify(request: Request) -> Response:
        """Where the broker wants certificates of agents. It ends with the pairing."""
        agent = await caller.agent(request)
        asked: schemas.CertificateRequest = await read(request, schemas.CertificateRequest)
        issued = await functions.agent_certificates.certify(agent, asked.request)
        return answer(schemas.CertificateOut(chain=issued.chain, expires_at=rfc3339(issued.expires_ms)))

    @routes.add(
        "POST",
        "/agents/claim",
        summary="Claim an agent with the code it shows",
        body=schemas.ClaimRequest,
        answers={200: schemas.ClaimOut},
        problems=(404, 429),
    )
    async def claim_agent(request: Request) -> Response:
        """A wrong, used and expired code are answered alike."""
        who = await caller.account(request)
        asked: schemas.ClaimRequest = await read(request, schemas.ClaimRequest)
        agent = await functions.claim.claim(
            who,
            asked.code,
            asked.space,
            address=client_address(request, functions.settings.trusted_proxies),
        )
        views = await functions.devices.of_agent(who, agent.id)
        found = tuple(device_out(view, who, functions.clock.now_ms()) for view in views)
        return answer(schemas.ClaimOut(agent=agent.id, space=agent.space or "", devices=found))

    @routes.add("GET", "/agents", summary="The account's agents", answers={200: schemas.AgentList}, problems=(422,))
    async def list_agents(request: Request, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Agents that the account has claimed."""
        who = await caller.account(request)
        agents, following = await functions.devices.agents(who, cursor=cursor, limit=limit)
        items = tuple(_shown(agent) for agent in agents)
        return answer(schemas.AgentList(items=items, cursor=following))

    @routes.add(
        "PUT",
        "/agents/{agent}/space",
        summary="Move an agent to another space",
        body=schemas.MoveAgentRequest,
        answers={200: schemas.AgentOut},
        problems=(404,),
    )
    async def move_agent(request: Request, agent: str) -> Response:
        """Its history stays; what its devices do ends, control is lost, and its broker connection is cut."""
        who = await caller.account(request)
        asked: schemas.MoveAgentRequest = await read(request, schemas.MoveAgentRequest)
        return answer(_shown(await functions.unpair.move(who, agent, asked.space)))

    @routes.add("DELETE", "/agents/{agent}", summary="Un-pair an agent", answers={204: None}, problems=(404,))
    async def unpair_agent(request: Request, agent: str) -> Response:
        """Its devices disappear, its broker connection is cut, and it waits to be claimed again."""
        await functions.unpair.unpair(await caller.account(request), agent)
        return empty()

    return routes


def _shown(agent: Agent) -> schemas.AgentOut:
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
