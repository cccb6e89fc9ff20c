"""Cleanup after a device's agent was unpaired or moved, or a device was removed.

The agent's row lists departures (``Agent.leaving``) in the deciding write. The cleanup is idempotent, is scheduled
before that write, and only affects the former pairing.
"""

import contextlib
import logging
from collections.abc import Iterable
from dataclasses import replace
from typing import Final

from device_agent.protocol import topics
from function_app.domain.actions.action import Status, end
from function_app.domain.actions.queue import DROPPED
from function_app.domain.common.ids import device_id
from function_app.domain.devices.access import Share, device_target
from function_app.domain.devices.devices import Agent, Departure, Device
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.certificates import Certificates
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable, CommandBus
from function_app.ports.tables import Conflict, Tables
from function_app.services.actions.action_store import ActionStore
from function_app.services.actions.queue import ActionQueues
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.fencing import ControlRevocation
from function_app.services.devices.control_rows import read_control_rows
from function_app.services.devices.device_access import departed_devices
from function_app.services.identity.authenticator import all_viewers
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders
from function_app.services.storage.retention import Retention
from function_app.services.telemetry.recordings import Recordings
from function_app.services.telemetry.series_writer import MARGIN_MS, SeriesWriter

CHECK_MS: Final = 5_000
"""Interval of retries while the broker is not reachable."""
_NOTE: Final = "leave:"
_RETAINED: Final = ((topics.STATE, ""), (topics.DESC, ""), (topics.DESC, topics.TWIN))

_log = logging.getLogger(__name__)

_MEASUREMENTS = (records.EVENTS, records.SESSIONS, records.TRIALS, records.FAULTS, records.DIAGNOSTICS, records.LATENCY)
"""Tables with a partition for each pairing of a device."""


class Offboarding:
    """Cleans up after agents and devices."""

    def __init__(
        self,
        *,
        tables: Tables,
        action_store: ActionStore,
        queues: ActionQueues,
        reminders: Reminders,
        revocation: ControlRevocation,
        access: BrokerAccess,
        certificates: Certificates,
        bus: CommandBus,
        series: SeriesWriter,
        recordings: Recordings,
        retention: Retention,
        control_events: ControlEvents,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._action_store = action_store
        self._queues = queues
        self._reminders = reminders
        self._revocation = revocation
        self._access = access
        self._certificates = certificates
        self._bus = bus
        self._series = series
        self._recordings = recordings
        self._retention = retention
        self._control_events = control_events
        self._clock = clock

    async def watch(self, agent: str) -> None:
        """Schedule the cleanup of an agent, before the deciding write."""
        await self._reminders.schedule(f"{_NOTE}{agent}", self._clock.now_ms() + CHECK_MS)

    async def finish(self, agent_id: str) -> bool:
        """Clean up all departures of an agent; return whether the cleanup is complete.

        Raises:
            Problem: ``busy``.
        """
        _, agent = await records.find(self._tables, records.AGENTS, agent_id, "agent", Agent)
        if agent is None:
            return True
        done = set()
        for leaving in agent.leaving:
            await self._settle(agent, leaving)
            try:
                await self._clean_broker(agent_id, leaving)
            except (BusUnavailable, BrokerAccessError) as error:
                _log.warning("%s of %s: %s", leaving.why, agent_id, error)
            else:
                done.add(leaving)
        if done:
            await self._remove_departures(agent_id, done)
        return len(done) == len(agent.leaving)

    async def settle(self, agent: Agent) -> None:
        """The part of the cleanup that only needs the tables, before the agent can be claimed again.

        Raises:
            Problem: ``busy``.
        """
        for leaving in agent.leaving:
            await self._settle(agent, leaving)

    async def _settle(self, agent: Agent, leaving: Departure) -> None:
        for device in departed_devices(agent, leaving):
            # Before the actions end, because their leases record who moved the device.
            await self._revocation.revoke(device, leaving.why)
            await self._end_actions(device, leaving.why)
            # While the agent's row still contains the former owner.
            await self._control_events.publish(device.id)
            await self._delete(records.AGENTS, agent.id, f"state:{device.name}", leaving)
            if leaving.why == "unpaired":
                await self._series.forget(device.id, device.pairing)
                await self._delete_measurements(device)
            if leaving.why != "moved":
                await self._delete(records.DESCRIPTIONS, agent.id, device.name, leaving)
        if leaving.why != "removed":
            await self._delete(records.AGENTS, agent.id, "link", leaving)
        if leaving.why == "unpaired":
            await self._delete(records.MEMBERS, leaving.account, f"agent:{agent.id}", leaving)

    async def _delete_measurements(self, device: Device) -> None:
        """Delete measurements, recordings, events and faults, after all processes have stopped writing them."""
        due_ms = self._clock.now_ms() + MARGIN_MS
        await self._recordings.forget(device, due_ms=due_ms)
        for table in _MEASUREMENTS:
            await self._retention.delete_partition_at(table, f"{device.id}/{device.pairing}", due_ms=due_ms)

    async def _end_actions(self, device: Device, why: str) -> None:
        _, message = DROPPED[why]
        control = await read_control_rows(self._tables, device.id)
        if control.queue.pairing == device.pairing:
            await self._queues.cancel_all(device.id, why)
        if control.action and control.slot_pairing == device.pairing:
            now_ms = self._clock.now_ms()
            await self._action_store.change(
                control.action, lambda action: end(action, Status.FAILED, why, message, now_ms)
            )

    async def _delete(self, table: str, partition: str, key: str, leaving: Departure) -> None:
        """Delete a row of the former pairing, unless it was rewritten."""
        row = await self._tables.get(table, partition, key)
        if row is not None and row.data.get("pairing", "") in {"", leaving.pairing}:
            await records.discard(self._tables, table, row)

    async def _clean_broker(self, agent_id: str, leaving: Departure) -> None:
        """Disconnect the agent, then clear its retained messages, including its will, but not new ones."""
        _, current = await records.find(self._tables, records.AGENTS, agent_id, "agent", Agent)
        if leaving.why != "removed":
            if leaving.why == "unpaired":
                await self._certificates.revoke(agent_id)
            elif current is not None and current.space is not None:
                await self._certificates.set_space(agent_id, current.space)
            await self._access.revoke(principal=f"agent:{agent_id}")
        if leaving.why == "unpaired":
            for name in leaving.devices:
                await self._end_shares(device_id(agent_id, name), leaving.pairing)
        _, agent = await records.find(self._tables, records.AGENTS, agent_id, "agent", Agent)
        existing = agent if agent is not None and agent.space == leaving.space else None
        if existing is None:
            await self._bus.publish(topics.conn(leaving.space, agent_id), b"", retain=True)
        for name in leaving.devices:
            if existing is not None and existing.device(name) is not None:
                continue
            for kind, stream in _RETAINED:
                topic = topics.device(leaving.space, agent_id, name, kind, stream)
                await self._bus.publish(topic, b"", retain=True)

    async def _end_shares(self, device: str, pairing: str) -> None:
        """Disconnect viewers with a share of the former pairing, then delete the share.

        Their filters contain topics of the device, which would match again if the same owner claimed it.
        """
        on = device_target(device)
        page = await self._tables.query(records.SHARES, on, first="account:", last="account;", limit=1000)
        for row in page.rows:
            share = records.read(row, Share)
            if share.pairing != pairing:
                continue
            await self._access.revoke(principal=all_viewers(share.account))
            with contextlib.suppress(Conflict):  # a renewed share keeps its index
                await self._tables.delete(records.SHARES, row)
                await records.remove(self._tables, records.MEMBERS, share.account, f"share:{on}")

    async def _remove_departures(self, agent_id: str, done: Iterable[Departure]) -> None:
        completed = set(done)

        async def attempt() -> None:
            row = await self._tables.get(records.AGENTS, agent_id, "agent")
            if row is None:
                return
            agent = records.read(row, Agent)
            left = tuple(leaving for leaving in agent.leaving if leaving not in completed)
            created = records.to_data(replace(agent, leaving=left))
            await self._tables.replace(records.AGENTS, row.changed(created))

        await records.retry(attempt)


def offboarding_of(note: str) -> str | None:
    """The agent of an offboarding reminder; ``None`` for other reminders."""
    return note.removeprefix(_NOTE) if note.startswith(_NOTE) else None
