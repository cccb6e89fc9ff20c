"""Unpairing an agent, and moving it to another space."""

from collections.abc import Callable

from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.problems import not_found
from function_app.domain.devices import devices as rules
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import Tables
from function_app.services.audit.audit_log import AuditLog, Change
from function_app.services.identity.sign_in import SignIn
from function_app.services.pairing.offboarding import Offboarding
from function_app.services.storage import records


class Unpair:
    """Ends pairings and moves agents."""

    def __init__(self, *, tables: Tables, sign_in: SignIn, offboarding: Offboarding, audit_log: AuditLog) -> None:
        self._tables = tables
        self._sign_in = sign_in
        self._offboarding = offboarding
        self._audit_log = audit_log

    async def unpair(self, caller: Identity, agent_id: str) -> None:
        """End the pairing. The write on the agent's row decides; the rest is cleanup.

        Leases, slots and actions contain their pairing, so remaining rows are ignored. Epochs continue to increase.

        Raises:
            Problem: ``agent-unknown``, ``busy``.
        """
        async with self._audit_log.change(caller.account, AccountEvent.AGENT_UNPAIRED, caller, on=agent_id) as change:
            changed = await self._change(caller, agent_id, rules.unpair, change)
        await self._finish(changed)

    async def move(self, caller: Identity, agent_id: str, space: str) -> Agent:
        """Move an agent to another space of its account. Its data remain; running actions end.

        Raises:
            Problem: ``agent-unknown``, ``space-unknown``, ``busy``.
        """
        own = {existing.id for existing in await self._sign_in.spaces(caller.account)}

        def moved(agent: Agent) -> Agent:
            if space not in own:
                raise not_found("space", space)
            return agent if agent.space == space else rules.move(agent, space)

        async with self._audit_log.change(
            caller.account, AccountEvent.AGENT_MOVED, caller, on=agent_id, space=space
        ) as change:
            changed = await self._change(caller, agent_id, moved, change)
        await self._finish(changed)
        return changed

    async def _change(self, caller: Identity, agent_id: str, rule: Callable[[Agent], Agent], change: Change) -> Agent:
        scheduled = False

        async def attempt() -> Agent:
            nonlocal scheduled
            row, agent = await records.find(self._tables, records.AGENTS, agent_id, "agent", Agent)
            if row is None or agent is None or agent.account != caller.account:
                raise not_found("agent", agent_id)
            changed = rule(agent)
            if changed is not agent:
                if not scheduled:
                    await self._offboarding.watch(agent_id)
                    scheduled = True
                await change.store_pending()
                await self._tables.replace(records.AGENTS, row.changed(records.to_data(changed)))
            return changed

        return await records.retry(attempt)

    async def _finish(self, agent: Agent) -> None:
        if agent.leaving:
            await self._offboarding.finish(agent.id)
