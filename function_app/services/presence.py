"""What agents say of themselves and their devices, into the tables: presence, description, state, events."""

from typing import TypeVar

import msgspec

from device_agent.protocol import codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.messages import Description, Event, Presence, State
from device_agent.protocol.topics import Topic
from function_app.domain.devices import Agent, LastState, Link, Transport, newer_link
from function_app.domain.ids import device_id, new_suffix
from function_app.domain.nesting import MAX_LEVELS, too_deep
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services import store
from function_app.services.forget import DAY_MS, Forget

KEEP_EVENTS_MS = 90 * DAY_MS
_NOTED = 4096
"""Days of devices whose end a process knows to be noted."""

T = TypeVar("T")


class PresenceIngest:
    """Writes down what arrives. Safe to repeat; what does not belong to a claimed agent is dropped."""

    def __init__(self, *, tables: Tables, forget: Forget, clock: Clock) -> None:
        self._tables = tables
        self._forget = forget
        self._clock = clock
        self._noted: dict[tuple[str, int, int], None] = {}

    async def ingest(self, topic: Topic, payload: bytes, *, by: Transport = "mqtt") -> None:
        """Take one message in.

        What an agent has said over HTTP is told to the broker too and comes back from there, perhaps late: then it is
        not taken a second time.

        Raises:
            ProtocolError: It is not what its topic says.
            Problem: ``busy``: not stored, to be delivered again.
        """
        row = await self._tables.get(store.AGENTS, topic.agent, "agent")
        if row is None:
            return
        agent = store.read(row, Agent)
        if agent.space != topic.space or (topic.device and agent.device(topic.device) is None):
            return
        if agent.transport == "mqtt" or by != "mqtt":
            await self._store(topic, payload, polled=agent.transport != "mqtt")

    async def _store(self, topic: Topic, payload: bytes, *, polled: bool) -> None:
        now_ms = self._clock.now_ms()
        if topic.kind == topics.CONN:
            presence = codec.decode(payload, Presence)
            link = Link(presence.online, presence.session, now_ms, polled)
            await store.upsert(
                self._tables, store.AGENTS, topic.agent, "link", lambda known: newer_link(known, link), Link
            )
        elif topic.kind == topics.STATE:
            state = LastState(msgspec.to_builtins(codec.decode(payload, State)), now_ms)
            await store.upsert(
                self._tables, store.AGENTS, topic.agent, f"state:{topic.device}", lambda _: state, LastState
            )
        elif topic.kind == topics.DESC and not topic.name:
            description = codec.decode(payload, Description)
            await store.upsert(
                self._tables, store.DESCRIPTIONS, topic.agent, topic.device, lambda _: description, Description
            )
        elif topic.kind == topics.EVENT:
            await self._event(topic, codec.decode(payload, Event), now_ms)

    async def _event(self, topic: Topic, event: Event, now_ms: int) -> None:
        """By its id, so that one that is delivered twice is stored once."""
        if too_deep(event.data):
            raise ProtocolError(f"the event's data are nested more than {MAX_LEVELS} levels deep")
        device = device_id(topic.agent, topic.device)
        data = {**msgspec.to_builtins(event), "seen_ms": now_ms, "expires_ms": now_ms + KEEP_EVENTS_MS}
        when = new_suffix(event.at_ms)[:9]
        await self._note(device, event.at_ms // DAY_MS, now_ms // DAY_MS)
        try:
            await self._tables.create(store.EVENTS, Row(device, f"{when}:{event.id}", data))
        except Conflict:
            return

    async def _note(self, device: str, day: int, seen_day: int) -> None:
        """See that the events of one day that were seen on another will be forgotten: one note for all of them."""
        known = (device, day, seen_day)
        if known in self._noted:
            return
        # Keys count down with time: the day's last moment comes first.
        first, last = (new_suffix((day + 1) * DAY_MS - 1)[:9], new_suffix(day * DAY_MS)[:9] + ";")
        due_ms = (seen_day + 1) * DAY_MS + KEEP_EVENTS_MS
        await self._forget.rows(store.EVENTS, device, first=first, last=last, due_ms=due_ms)
        self._noted[known] = None
        if len(self._noted) > _NOTED:
            del self._noted[next(iter(self._noted))]
