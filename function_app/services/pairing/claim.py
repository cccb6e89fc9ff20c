"""Claiming an agent with the code that it displays."""

from dataclasses import dataclass

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.ids import new_id, parse_claim_code
from function_app.domain.common.problems import Problem, not_found
from function_app.domain.devices import devices
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.audit.audit_log import AuditLog, Change
from function_app.services.identity.guess_limiter import Guess, GuessLimiter, by_address
from function_app.services.identity.sign_in import SignIn
from function_app.services.pairing.offboarding import Offboarding
from function_app.services.storage import records

WRONG_TRIES = 5
GUESS = Guess("claim", 300_000, "Too many wrong claim codes.")


@dataclass(frozen=True, slots=True)
class _Member:
    pairing: str = ""


class Claim:
    """Pairing by claim code. One ETag write on the agent's row decides."""

    def __init__(
        self,
        *,
        tables: Tables,
        sign_in: SignIn,
        guess_limiter: GuessLimiter,
        offboarding: Offboarding,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._guess_limiter = guess_limiter
        self._offboarding = offboarding
        self._sign_in = sign_in
        self._audit_log = audit_log
        self._clock = clock

    async def claim(self, caller: Identity, text: str, space: str | None, *, address: str = "") -> Agent:
        """Claim the agent that displays this code for ``caller``.

        Wrong codes are counted by account and, if known, by client address.

        Raises:
            Problem: ``claim-code-unknown``: wrong, used or expired; ``too-many-tries``; ``space-unknown``.
        """
        spaces = await self._sign_in.spaces(caller.account)
        target_space = next((existing.id for existing in spaces if space in (None, existing.id)), None)
        if target_space is None:
            raise not_found("space", space or "")
        counters = {caller.account: WRONG_TRIES, **by_address(address, WRONG_TRIES)}
        try:
            await self._guess_limiter.add_failure(GUESS, counters)
            agent = await self._redeem(caller, parse_claim_code(text), target_space)
        except Problem as problem:
            await self._refused(caller, problem, address)
            raise
        if agent is None:
            detail = "This code is wrong, used or expired. Codes are valid for five minutes; use the newest one."
            unknown = Problem("claim-code-unknown", 404, "No such claim code", detail)
            await self._refused(caller, unknown, address)
            raise unknown
        await self._guess_limiter.remove_failure(GUESS, counters)
        return agent

    async def _refused(self, caller: Identity, problem: Problem, address: str) -> None:
        await self._audit_log.record_rejection(
            caller.account, AccountEvent.CLAIM_REJECTED, caller, code=problem.code, address=address
        )

    async def _redeem(self, caller: Identity, code: str | None, space: str) -> Agent | None:
        if code is None:
            return None
        result = await self._tables.get(records.CLAIMS, code[0], code)
        if result is None:
            return None
        agent = str(result.data["agent"])
        async with self._audit_log.change(
            caller.account, AccountEvent.AGENT_CLAIMED, caller, on=agent, space=space
        ) as change:
            claimed = await records.retry(lambda: self._take(caller, code, agent, space, change))
            if claimed is None:
                change.discarded = True
        if claimed is not None:
            await records.discard(self._tables, records.CLAIMS, result)
        return claimed

    async def _take(self, caller: Identity, code: str, agent_id: str, space: str, change: Change) -> Agent | None:
        row = await self._tables.get(records.AGENTS, agent_id, "agent")
        if row is None:
            return None
        agent = records.read(row, Agent)
        now_ms = self._clock.now_ms()
        if agent.claimed or agent.claim_code != code or now_ms >= agent.claim_expires_ms:
            return None
        await self._offboarding.settle(agent)
        await change.store_pending()
        claimed = devices.claim(agent, account=caller.account, space=space, pairing=new_id(), now_ms=now_ms)
        # Written first: without the agent's row the index entry has no effect.
        member = _Member(claimed.pairing)
        await records.upsert(
            self._tables, records.MEMBERS, caller.account, f"agent:{agent.id}", lambda _: member, _Member
        )
        await self._tables.replace(records.AGENTS, row.changed(records.to_data(claimed)))
        return claimed
