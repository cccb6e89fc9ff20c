"""Handing an agent, or a space with all that is in it, over to another account that has accepted it.

One write on the agent's row takes it from one account to the other: it is nobody's at no time. Everything else is as
after an un-pairing and a claim (``services/leave.py``): what the former owner, and with whom they shared it, saw and
did ends, and nothing of it goes with the agent, which learns of its new owner by itself. A space becomes a new space of
the new owner: topics name the space, and nobody who knew the former one's hears anything in the other.

The accepted invitation stays until all of it is done, with a note for the timer.
"""

import contextlib
from dataclasses import dataclass

from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem
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
    """Carries out transfers that were accepted. Every step is safe to repeat."""

    def __init__(
        self, *, tables: Tables, devices: DeviceAccess, sharing: Sharing, offboarding: Offboarding, clock: Clock
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._sharing = sharing
        self._offboarding = offboarding
        self._clock = clock

    async def carry_out(self, taken: Invitation) -> None:
        """Do what is left of it.

        Raises:
            Problem: ``busy``; ``transfer-impossible``: the agent is no longer whose it was offered by.
        """
        kind, name = split_target(taken.on)
        if kind == "agent":
            if not await self._hand_over(name, taken, pairing=taken.pairing):
                raise invalidate()
            return
        await self._carry_space(name, taken)

    async def _carry_space(self, name: str, taken: Invitation) -> None:
        """The new space, then the former one's end, so that nothing more comes into it, then what is in it."""
        row = Row(
            taken.taken_by,
            f"space:{taken.taken_space}",
            records.to_data(Space(taken.taken_space, taken.label, self._clock.now_ms())),
        )
        with contextlib.suppress(Conflict):
            await self._tables.create(records.ACCOUNTS, row)
        former = await self._tables.get(records.ACCOUNTS, taken.owner, f"space:{name}")
        if former is not None:
            with contextlib.suppress(Conflict):
                await self._tables.delete(records.ACCOUNTS, former)
        for agent in sorted({device.agent for device in await self._devices.in_space(taken.owner, name)}):
            await self._hand_over(agent, taken, space=name)
        await self._sharing.end_all(space_target(name))

    async def _hand_over(self, agent_id: str, taken: Invitation, *, pairing: str = "", space: str = "") -> bool:
        """Take an agent over, if it is still of that pairing, or in that space; whether it is the new owner's."""
        await self._offboarding.watch(agent_id)

        async def attempt() -> Agent | None:
            row = await self._tables.get(records.AGENTS, agent_id, "agent")
            agent = records.read(row, Agent) if row else None
            if row is None or agent is None:
                return None
            if agent.account != taken.owner or (pairing or agent.pairing) != agent.pairing:
                return agent
            if space and agent.space != space:
                return agent
            now_ms = self._clock.now_ms()
            changed = rules.transfer(
                agent, account=taken.taken_by, space=taken.taken_space, pairing=new_id(), now_ms=now_ms
            )
            member = _Member(changed.pairing)
            await records.upsert(
                self._tables, records.MEMBERS, taken.taken_by, f"agent:{agent_id}", lambda _: member, _Member
            )
            await self._tables.replace(records.AGENTS, Row(agent_id, "agent", records.to_data(changed), row.etag))
            return changed

        agent = await records.retry(attempt)
        if agent is not None and agent.leaving:
            await self._offboarding.finish(agent_id)
        return agent is not None and agent.account == taken.taken_by


def invalidate() -> Problem:
    """What was offered is not the offerer's any more."""
    detail = "It has gone to somebody else, or was un-paired, since it was offered. Ask its owner for a new invitation."
    return Problem("transfer-impossible", 409, "It cannot be handed over", detail)
