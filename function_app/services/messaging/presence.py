"""Stores presence, descriptions, states and events of agents and devices."""

from typing import TypeVar

import msgspec

from device_agent.protocol import Description, Event, Presence, State, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.events import EventKind
from device_agent.protocol.fields import printable
from device_agent.protocol.state import unverified
from device_agent.protocol.topics import Topic
from function_app.domain.audit.hash_chain import CLOUD, Entry
from function_app.domain.common.ids import device_id
from function_app.domain.common.json_depth import MAX_LEVELS, too_deep
from function_app.domain.common.timestamps import LAST_MS
from function_app.domain.devices.devices import Agent, DeviceEpochs, LastState, Link, Transport, newer_link
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.devices.control_rows import record_device_epochs
from function_app.services.health.reported_faults import ReportedFaults
from function_app.services.messaging.camera_consents import CameraConsents
from function_app.services.messaging.key_announcer import KeyAnnouncer
from function_app.services.storage import records
from function_app.services.telemetry.event_log import EventLog
from function_app.services.telemetry.session_log import SessionLog

SAME_STOP_MS = 60_000
"""Longest time in which the report of a Stop may follow its record [ms]."""

T = TypeVar("T")


class PresenceIngest:
    """Stores messages. Idempotent; messages that do not belong to a claimed agent are dropped."""

    def __init__(
        self,
        *,
        tables: Tables,
        events: EventLog,
        sessions: SessionLog,
        audit_log: AuditLog,
        reported_faults: ReportedFaults,
        key_announcer: KeyAnnouncer,
        camera_consents: CameraConsents,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._events = events
        self._sessions = sessions
        self._audit_log = audit_log
        self._reported_faults = reported_faults
        self._key_announcer = key_announcer
        self._camera_consents = camera_consents
        self._clock = clock

    async def ingest(self, topic: Topic, payload: bytes, *, by: Transport) -> None:
        """Store one message.

        Messages from other transports are republished on the broker and return from there later; they are stored only
        once.

        Raises:
            ProtocolError: The message does not match its topic.
            Problem: ``busy``: not stored; deliver it again.
        """
        row = await self._tables.get(records.AGENTS, topic.agent, "agent")
        if row is None:
            return
        agent = records.read(row, Agent)
        if agent.space != topic.space or (topic.device and agent.device(topic.device) is None):
            return
        if agent.transport == "mqtt" or by != "mqtt":
            await self._store(agent, topic, payload, by)

    async def _store(self, agent: Agent, topic: Topic, payload: bytes, by: Transport) -> None:
        now_ms = self._clock.now_ms()
        if topic.kind == topics.CONN:
            presence = codec.decode(payload, Presence)
            link = Link(
                online=presence.online,
                session=presence.session,
                seen_ms=now_ms,
                polled=by == "http",
                pairing=agent.pairing,
                protocol=(presence.protocol.min, presence.protocol.max),
                capabilities=presence.capabilities,
            )
            if link.online:
                await self._reported_faults.on_connected(agent, link.session)
            await records.upsert(
                self._tables, records.AGENTS, topic.agent, "link", lambda existing: newer_link(existing, link), Link
            )
        elif topic.kind == topics.STATE:
            state = codec.decode(payload, State)
            await self._reported_faults.on_state(agent, topic.device, state)
            epochs = DeviceEpochs(state.epoch, state.ended_epoch, agent.pairing)
            await record_device_epochs(self._tables, device_id(topic.agent, topic.device), epochs)
            last_state = LastState(msgspec.to_builtins(state), now_ms, agent.pairing)
            await records.upsert(
                self._tables, records.AGENTS, topic.agent, f"state:{topic.device}", lambda _: last_state, LastState
            )
            await self._key_announcer.on_state(agent, topic.device)
            await self._camera_consents.on_state(agent, topic.device, state)
        elif topic.kind == topics.DESC and not topic.name:
            description = codec.decode(payload, Description)
            await records.upsert(
                self._tables, records.DESCRIPTIONS, topic.agent, topic.device, lambda _: description, Description
            )
        elif topic.kind == topics.EVENT:
            await self._event(agent, topic, codec.decode(payload, Event))

    async def _event(self, agent: Agent, topic: Topic, event: Event) -> None:
        """Store an event by its id, so that a duplicate has no effect."""
        if too_deep(event.data):
            raise ProtocolError(f"the event's data are nested more than {MAX_LEVELS} levels deep")
        if event.at_ms > LAST_MS:
            raise ProtocolError("the event's `at_ms` is not a time of milliseconds since 1970")
        device = device_id(topic.agent, topic.device)
        if event.kind == EventKind.ACTIVITY:
            await self._sessions.add_activity(device, agent.pairing, event.data)
            return
        await self._events.add(device, agent.pairing, msgspec.to_builtins(event))
        if event.kind == EventKind.STOP_LATCHED and not await self._is_recorded(device, agent.pairing, event):
            await self._audit_log.append_all(agent.account or CLOUD, [_stop_entry(device, event)])

    async def _is_recorded(self, device: str, pairing: str, event: Event) -> bool:
        """Whether the functions have just sent and recorded this Stop. Others reached the device over the broker.

        The id of a Stop is not secret. A Stop that repeats an old one is therefore recorded.
        """
        age_ms = await self._events.command_age_ms(device, pairing, str(event.data.get("stop", "")))
        return age_ms is not None and age_ms <= SAME_STOP_MS


def _stop_entry(device: str, event: Event) -> Entry:
    """The audit record of a reported Stop. Its author is unverified: a broker could have changed the report.

    A Stop that the functions have sent has a record of its own.
    """
    caller, reason = (printable(str(event.data.get(name, ""))) for name in ("caller", "reason"))
    data = {"message": printable(event.message), "caller": unverified(caller), "reason": reason, "verified": False}
    return Entry(f"{device}/{event.id}", event.at_ms, event.kind, target=device, actor=unverified(caller), data=data)
