"""The session of one agent at the gateway: stores its messages, and sends commands to it."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence

import msgspec

from device_agent.protocol import Presence, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import stanzas
from device_agent.protocol.xmpp.stanzas import Delivery
from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent, Link
from function_app.entrypoints.ingest.agent_messages import ingest_messages, own_topic
from function_app.ports.tables import StoreError
from function_app.ports.xmpp_connection import XmppConnection
from function_app.services.storage import records
from function_app.services.telemetry.ingest import InboundMessage

MAX_QUEUED = 1000
MAX_QUEUED_BYTES = 4 * 1024 * 1024
"""Limits of the queue of messages to store. Further messages are not acknowledged, so the agent resends them."""
MAX_MEASUREMENTS = 100
"""Limit of the queue of measurements to publish: two seconds of one stream at 50 Hz. The oldest are dropped."""
BATCH = 32
MAX_ATTEMPTS = 6
FIRST_PAUSE_S = 0.1
POLL_S = 1.0
"""Poll interval of the mailbox while the broker delivers commands. Commands found in two polls are sent."""
POLL_WITHOUT_BROKER_S = 0.25
"""Poll interval of the mailbox without the broker. All commands are sent."""
CHECK_S = 5.0
"""Interval of the check that pairing and space are unchanged. Unpairing also triggers it through the broker."""

_log = logging.getLogger(__name__)


class AgentSession:
    """The session of one agent.

    Args:
        functions: Services of the cloud.
        connection: Connection to the XMPP server.
        agent: The agent's row at the start of the session.
        jid: Full JID.
        presence: The presence message that started the session.
        delivery: The same message as received.
        subscriptions: Topics of other agents in its space to which it subscribes.
        broker_up: Returns whether the broker delivers commands now.
        on_measurement: Called with each published measurement.
        on_stored: Called with each other message after it is stored.
    """

    def __init__(
        self,
        functions: Functions,
        connection: XmppConnection,
        *,
        agent: Agent,
        jid: str,
        presence: Presence,
        delivery: Delivery,
        subscriptions: Sequence[str],
        broker_up: Callable[[], bool],
        on_measurement: Callable[[InboundMessage], None],
        on_stored: Callable[[Agent, Delivery], None],
    ) -> None:
        self.agent = agent
        self.jid = jid
        self.presence = presence
        self.delivery = delivery
        self.subscriptions = frozenset(subscriptions)
        self._functions = functions
        self._connection = connection
        self._broker_up = broker_up
        self._on_measurement = on_measurement
        self._on_stored = on_stored
        self._queue: asyncio.Queue[Delivery | None] = asyncio.Queue()
        self._measurements: asyncio.Queue[Delivery] = asyncio.Queue()
        self._check_requested = asyncio.Event()
        self._closed = False
        self._replaced = False
        self._queued_bytes = 0

    # ------------------------------------------------------------ inputs

    def receive(self, delivery: Delivery) -> None:
        """Queue a message of the agent."""
        if delivery.id == "" and f"/{topics.TELE}/" in delivery.topic:
            if self._measurements.qsize() >= MAX_MEASUREMENTS:
                self._measurements.get_nowait()
            self._measurements.put_nowait(delivery)
        elif self._queue.qsize() < MAX_QUEUED and self._queued_bytes < MAX_QUEUED_BYTES:
            self._queued_bytes += len(delivery.payload)
            self._queue.put_nowait(delivery)

    def send(self, topic: str, payload: bytes) -> None:
        """Send a message of the broker to the agent."""
        if (f"/{topics.CTL}/" in topic or f"/{topics.TELE}/" in topic) and self._connection.congested():
            return  # a newer setpoint or measurement follows
        self._connection.send(stanzas.message(self.jid, topic, payload))

    def request_check(self) -> None:
        """Check pairing and space now."""
        self._check_requested.set()

    def close(self, *, replaced: bool = False) -> None:
        """End the session after the queued messages are stored. Stores "offline" unless a new session exists."""
        self._replaced = self._replaced or replaced
        if not self._closed:
            self._closed = True
            self._queue.put_nowait(None)

    # ------------------------------------------------------------ tasks

    async def run(self) -> bool:
        """Run until the agent disconnects; ``False``: its pairing, space or transport has changed."""
        delivering = asyncio.create_task(self._deliver_commands())
        publishing = asyncio.create_task(self._publish_measurements())
        storing = asyncio.create_task(self._store_messages())
        tasks = (delivering, publishing, storing)
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if storing.done():
                storing.result()
                return True
            if delivering.done():
                return delivering.result()
            publishing.result()
            return True
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _store_messages(self) -> None:
        """Store the agent's messages in order and acknowledge them."""
        while True:
            batch = [await self._queue.get()]
            while not self._queue.empty() and len(batch) < BATCH:
                batch.append(self._queue.get_nowait())
            deliveries = [each for each in batch if each is not None]
            self._queued_bytes -= sum(len(each.payload) for each in deliveries)
            if deliveries:
                await self._store(deliveries)
            if None in batch:
                if self._replaced or await self._has_newer_session():
                    return
                at_ms = self._functions.clock.now_ms()
                offline = msgspec.structs.replace(self.presence, online=False, at_ms=at_ms)
                await self._store([Delivery(topics.conn(self.agent.space or "", self.agent.id), codec.encode(offline))])
                return

    async def _store(self, batch: list[Delivery]) -> None:
        pause_s = FIRST_PAUSE_S
        for _ in range(MAX_ATTEMPTS):
            try:
                messages = [(delivery.topic, delivery.payload) for delivery in batch]
                rejections = await ingest_messages(self._functions, self.agent, messages, by="xmpp")
            except (StoreError, Problem) as error:
                _log.warning("messages of %s were not stored: %s", self.agent.id, error)
                await asyncio.sleep(pause_s)
                pause_s *= 2
                continue
            for delivery, rejection in zip(batch, rejections, strict=True):
                if rejection is None:
                    self._on_stored(self.agent, delivery)
                    stanza = stanzas.receipt(self.jid, delivery.id)
                else:
                    _log.warning("rejected a message of %s: %s", self.agent.id, rejection)
                    stanza = stanzas.rejection(self.jid, delivery.id, rejection)
                if delivery.id:
                    self._connection.send(stanza)
            return
        # Not acknowledged: the agent starts a new session and resends.
        self._connection.send(stanzas.presence(to=self.jid, available=False))

    async def _publish_measurements(self) -> None:
        """Publish measurements immediately. The gateway stores them later in batches."""
        while True:
            batch = [await self._measurements.get()]
            while not self._measurements.empty():
                batch.append(self._measurements.get_nowait())
            messages = []
            for delivery in batch:
                try:
                    topic = own_topic(delivery.topic, self.agent)
                except ProtocolError as error:
                    _log.warning("dropped a measurement of %s: %s", self.agent.id, error)
                    continue
                messages.append((delivery.topic, topic, delivery.payload))
                self._on_measurement(InboundMessage(topic, delivery.payload))
            await self._functions.relay.publish(messages)

    async def _deliver_commands(self) -> bool:
        """Send commands from the mailbox until pairing, space or transport changes; then returns ``False``."""
        loop = asyncio.get_running_loop()
        seen: set[str] | None = None
        sent_s: dict[str, float] = {}
        checked_s = loop.time()
        while True:
            try:
                if loop.time() - checked_s > CHECK_S or self._check_requested.is_set():
                    self._check_requested.clear()
                    checked_s = loop.time()
                    if not await self._is_unchanged():
                        return False
                commands = await self._functions.mailbox.pending(self.agent, limit=BATCH)
            except (StoreError, Problem) as error:
                _log.warning("the mailbox of %s is not available: %s", self.agent.id, error)
                await asyncio.sleep(POLL_S)
                continue
            now_s = loop.time()
            without_broker = not self._broker_up()
            sent_s = {command.command: sent_s[command.command] for command in commands if command.command in sent_s}
            for command in commands:
                overdue = seen is None or without_broker or command.command in seen
                if overdue and now_s - sent_s.get(command.command, float("-inf")) >= POLL_S:
                    sent_s[command.command] = now_s
                    self._connection.send(stanzas.message(self.jid, command.topic, command.payload))
            seen = {command.command for command in commands}
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(POLL_WITHOUT_BROKER_S if without_broker else POLL_S):
                    await self._check_requested.wait()

    async def _has_newer_session(self) -> bool:
        """Whether the agent has started a newer session, at this or another gateway."""
        try:
            row = await self._functions.tables.get(records.AGENTS, self.agent.id, "link")
        except StoreError:
            return False
        return row is not None and records.read(row, Link).session > self.presence.session

    async def _is_unchanged(self) -> bool:
        _, current = await records.find(self._functions.tables, records.AGENTS, self.agent.id, "agent", Agent)
        if current is None or not current.claimed or current.transport != "xmpp":
            return False
        if (current.pairing, current.space) != (self.agent.pairing, self.agent.space):
            return False
        self.agent = current
        return True
