"""Transfers an agent, or a space with its agents, to another account that has accepted it.

One write on the agent's row changes the owner. The rest follows unpairing and claiming (``Offboarding``): shares,
leases and actions of the former owner end, and their data stay invisible. A space becomes a new space with another id,
so subscribers of the former topics receive nothing from it.

The accepted invitation and a reminder remain until the transfer is complete.
"""

import contextlib
from dataclasses import dataclass

from function_app.domain.common.ids import new_id
from function_app.domain.devices import devices as rules
from function_app.domain.devices.access import space_target, split_target
from function_app.domain.devices.devices import Agent
from function_app.domain.devices.invitations import Invitation
from function_app.domain.identity.accounts import Space
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.pairing.offboarding import Offboarding
from function_app.services.sharing.shares import Sharing
from function_app.services.storage import records


@dataclass(frozen=True, slots=True)
class _Member:
    pairing: str = ""


class OwnershipTransfer:
    """Executes accepted transfers. Every step is idempotent."""

    def __init__(
        self, *, tables: Tables, devices: DeviceAccess, sharing: Sharing, offboarding: Offboarding, clock: Clock
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._sharing = sharing
        self._offboarding = offboarding
        self._clock = clock

    async def carry_out(self, invitation: Invitation) -> bool:
        """Execute the remaining steps; return False if the agent has another owner than the offering account.

        Raises:
            Problem: ``busy``.
        """
        kind, name = split_target(invitation.on)
        if kind == "agent":
            return await self._transfer_agent(name, invitation, pairing=invitation.pairing)
        await self._transfer_space(name, invitation)
        return True

    async def _transfer_space(self, name: str, invitation: Invitation) -> None:
        """Create the new space, close the former one, then move its agents."""
        row = Row(
            invitation.taken_by,
            f"space:{invitation.taken_space}",
            records.to_data(Space(invitation.taken_space, invitation.label, self._clock.now_ms())),
        )
        with contextlib.suppress(Conflict):
            await self._tables.create(records.ACCOUNTS, row)
        await records.remove(self._tables, records.ACCOUNTS, invitation.owner, f"space:{name}")
        for agent in sorted({device.agent for device in await self._devices.in_space(invitation.owner, name)}):
            await self._transfer_agent(agent, invitation, space=name)
        await self._sharing.end_all(space_target(name))

    async def _transfer_agent(
        self, agent_id: str, invitation: Invitation, *, pairing: str = "", space: str = ""
    ) -> bool:
        """Transfer an agent of this pairing or space; return whether the new owner has it."""
        await self._offboarding.watch(agent_id)

        async def attempt() -> Agent | None:
            row, agent = await records.find(self._tables, records.AGENTS, agent_id, "agent", Agent)
            if row is None or agent is None:
                return None
            offered = (invitation.owner, pairing or agent.pairing, space or agent.space)
            if (agent.account, agent.pairing, agent.space) != offered:
                return agent
            now_ms = self._clock.now_ms()
            changed = rules.transfer(
                agent, account=invitation.taken_by, space=invitation.taken_space, pairing=new_id(), now_ms=now_ms
            )
            member = _Member(changed.pairing)
            await records.upsert(
                self._tables, records.MEMBERS, invitation.taken_by, f"agent:{agent_id}", lambda _: member, _Member
            )
            await self._tables.replace(records.AGENTS, row.changed(records.to_data(changed)))
            return changed

        agent = await records.retry(attempt)
        if agent is not None and agent.leaving:
            await self._offboarding.finish(agent_id)
        return agent is not None and agent.account == invitation.taken_by
