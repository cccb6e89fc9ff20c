"""Giving an agent up: its devices are gone for the account, its rights on the broker are taken back."""

import contextlib
import logging

from device_agent.protocol.messages import ReleaseLease
from function_app.domain import devices as rules
from function_app.domain.accounts import Identity
from function_app.domain.devices import Agent, Device
from function_app.domain.lease import Lease
from function_app.domain.problems import not_found
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services import store
from function_app.services.commands import Commands
from function_app.services.control import read_control
from function_app.services.devices import devices_of
from function_app.services.series import SeriesWriter

_log = logging.getLogger(__name__)


class Unpair:
    """Ends a pairing."""

    def __init__(self, *, tables: Tables, commands: Commands, access: BrokerAccess, series: SeriesWriter) -> None:
        self._tables = tables
        self._commands = commands
        self._access = access
        self._series = series

    async def unpair(self, who: Identity, agent_id: str) -> None:
        """End the pairing. The write on the agent's row decides; all that follows only tidies up.

        Leases, slots and actions name the pairing they belong to: what a stop half way leaves is nobody's, and the
        epochs go on from where they were.

        Raises:
            Problem: ``agent-unknown``, ``busy``.
        """

        async def once() -> Agent:
            row = await self._tables.get(store.AGENTS, agent_id, "agent")
            agent = store.read(row, Agent) if row else None
            if row is None or agent is None or agent.account != who.account:
                raise not_found("agent", agent_id)
            gone = store.fields(rules.unpair(agent))
            await self._tables.replace(store.AGENTS, Row(agent_id, "agent", gone, row.etag))
            return agent

        agent = await store.retry(once)
        for device in devices_of(agent):
            await self._fence(device, who)
            await self._series.forget(device.id, device.pairing)
        await self._forget(who, agent)
        try:
            await self._access.revoke(principal=f"agent:{agent.id}")
        except BrokerAccessError as error:
            _log.warning("un-pairing of %s: %s", agent.id, error)

    async def _fence(self, device: Device, who: Identity) -> None:
        """Raise the epoch, so that the former holder's setpoints are old, and bring the device to a hold."""

        async def once() -> Lease:
            control = await read_control(self._tables, device)
            lease = Lease(epoch=(control.lease.epoch if control.lease else 0) + 1)
            await self._tables.batch(store.CONTROL, [control.write_lease(device.id, lease)])
            return lease

        lease = await store.retry(once)
        try:
            await self._commands.send(device, ReleaseLease(), who=who.name, epoch=lease.epoch)
        except BusUnavailable as error:
            _log.warning("un-pairing of %s: %s", device.id, error)

    async def _forget(self, who: Identity, agent: Agent) -> None:
        rows = [await self._tables.get(store.MEMBERS, who.account, f"agent:{agent.id}")]
        page = await self._tables.query(store.AGENTS, agent.id, first="link", limit=1000)
        for table, row in ((store.MEMBERS, rows[0]), *((store.AGENTS, row) for row in page.rows)):
            if row is not None:
                with contextlib.suppress(Conflict):
                    await self._tables.delete(table, row)
