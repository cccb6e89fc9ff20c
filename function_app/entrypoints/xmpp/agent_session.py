"""One agent that has greeted this program: what it says goes in, what is addressed to it goes out."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence

from device_agent.protocol import Presence, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import stanzas
from device_agent.protocol.xmpp.stanzas import Delivery
from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent, Link
from function_app.entrypoints.ingest.agent_messages import own_topic, tell
from function_app.ports.tables import StoreError
from function_app.ports.xmpp_connection import XmppConnection
from function_app.services.storage import records
from function_app.services.telemetry.ingest import InboundMessage

MOST_WAITING = 1000
MOST_WAITING_BYTES = 4 * 1024 * 1024
"""Messages of one agent that wait for storage. Further messages are not acknowledged, so the agent resends them."""
MOST_MEASURED = 100
"""Measurements that wait to be passed on: two seconds of one stream at 50 Hz. The oldest go."""
AT_ONCE = 32
TRIES = 6
FIRST_PAUSE_S = 0.1
LOOK_S = 1.0
"""How often the mailbox is looked into while the broker brings what is for the agent; what was there twice is sent."""
LOOK_ALONE_S = 0.25
"""The same where the broker brings nothing."""
CHECK_S = 5.0
"""How often it is seen whether the agent is still whose it was. Un-pairing tells by the broker as well."""

_log = logging.getLogger(__name__)


class AgentSession:
    """The session of one agent.

    Args:
        functions: Services of the cloud.
        line: Connection to the XMPP server.
        agent: The agent's row at the start of the session.
        jid: Full JID.
        greeting: The presence message that started the session, decoded.
        greeted: The same message as received.
        listen: Topics of other agents in its space to which it subscribes.
        broker_up: Returns whether the broker delivers commands now.
        measured: Called with each measurement that was published.
        told: Called with each other message once it is stored.
    """

    def __init__(
        self,
        functions: Functions,
        line: XmppConnection,
        *,
        agent: Agent,
        jid: str,
        greeting: Presence,
        greeted: Delivery,
        listen: Sequence[str],
        broker_up: Callable[[], bool],
        measured: Callable[[InboundMessage], None],
        told: Callable[[Agent, Delivery], None],
    ) -> None:
        self.agent = agent
        self.jid = jid
        self.greeting = greeting
        self.greeted = greeted
        self.listen = frozenset(listen)
        self._functions = functions
        self._line = line
        self._broker_up = broker_up
        self._measured = measured
        self._told = told
        self._waiting: asyncio.Queue[Delivery | None] = asyncio.Queue()
        self._streams: asyncio.Queue[Delivery] = asyncio.Queue()
        self._doubt = asyncio.Event()
        self._left = False
        self._replaced = False
        self._waiting_bytes = 0

    # ------------------------------------------------------------ what happens to it

    def say(self, told: Delivery) -> None:
        """It has told something."""
        if told.id == "" and f"/{topics.TELE}/" in told.topic:
            if self._streams.qsize() >= MOST_MEASURED:
                self._streams.get_nowait()
            self._streams.put_nowait(told)
        elif self._waiting.qsize() < MOST_WAITING and self._waiting_bytes < MOST_WAITING_BYTES:
            self._waiting_bytes += len(told.payload)
            self._waiting.put_nowait(told)

    def order(self, topic: str, payload: bytes) -> None:
        """Something for it came by the broker."""
        if (f"/{topics.CTL}/" in topic or f"/{topics.TELE}/" in topic) and self._line.congested():
            return  # the next one is newer
        self._line.send(stanzas.message(self.jid, topic, payload))

    def doubt(self) -> None:
        """Look now whether it is still whose it was."""
        self._doubt.set()

    def leave(self, *, replaced: bool = False) -> None:
        """It has gone: what it had said is stored, then that it has gone; not where it is back already."""
        self._replaced = self._replaced or replaced
        if not self._left:
            self._left = True
            self._waiting.put_nowait(None)

    # ------------------------------------------------------------ work

    async def run(self) -> bool:
        """Serve until it has gone; ``False`` where it has no right to be there any more."""
        bringing = asyncio.create_task(self._bring())
        streaming = asyncio.create_task(self._stream())
        taking = asyncio.create_task(self._take())
        tasks = (bringing, streaming, taking)
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if taking.done():
                taking.result()
                return True
            if bringing.done():
                return bringing.result()
            streaming.result()
            return True
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _take(self) -> None:
        """Store what it says, in order, and confirm it."""
        while True:
            batch = [await self._waiting.get()]
            while not self._waiting.empty() and len(batch) < AT_ONCE:
                batch.append(self._waiting.get_nowait())
            told = [each for each in batch if each is not None]
            self._waiting_bytes -= sum(len(each.payload) for each in told)
            if told:
                await self._store(told)
            if None in batch:
                if self._replaced or await self._is_back():
                    return
                gone = Presence(
                    online=False,
                    session=self.greeting.session,
                    at_ms=self._functions.clock.now_ms(),
                    software=self.greeting.software,
                )
                await self._store([Delivery(topics.conn(self.agent.space or "", self.agent.id), codec.encode(gone))])
                return

    async def _store(self, batch: list[Delivery]) -> None:
        pause_s = FIRST_PAUSE_S
        for _ in range(TRIES):
            try:
                refused = await tell(
                    self._functions, self.agent, [(told.topic, told.payload) for told in batch], by="xmpp"
                )
            except (StoreError, Problem) as error:
                _log.warning("messages of %s: %s", self.agent.id, error)
                await asyncio.sleep(pause_s)
                pause_s *= 2
                continue
            for told, why in zip(batch, refused, strict=True):
                if why is not None:
                    _log.warning("a message of %s was refused: %s", self.agent.id, why)
                else:
                    self._told(self.agent, told)
                if told.id:
                    self._line.send(
                        stanzas.receipt(self.jid, told.id) if why is None else stanzas.rejection(self.jid, told.id, why)
                    )
            return
        # Not acknowledged: the agent starts a new session and resends.
        self._line.send(stanzas.presence(to=self.jid, available=False))

    async def _stream(self) -> None:
        """Pass measurements on at once; they are stored later, many at a time."""
        while True:
            batch = [await self._streams.get()]
            while not self._streams.empty():
                batch.append(self._streams.get_nowait())
            passed = []
            for told in batch:
                try:
                    topic = own_topic(told.topic, self.agent)
                except ProtocolError as error:
                    _log.warning("a measurement of %s was dropped: %s", self.agent.id, error)
                    continue
                passed.append((told.topic, topic, told.payload))
                self._measured(InboundMessage(topic, told.payload))
            await self._functions.relay.publish(passed)

    async def _bring(self) -> bool:
        """Bring what waits in the mailbox, for as long as the agent is whose it was; then ``False``."""
        loop = asyncio.get_running_loop()
        seen: set[str] | None = None
        sent_s: dict[str, float] = {}
        checked_s = loop.time()
        while True:
            try:
                if loop.time() - checked_s > CHECK_S or self._doubt.is_set():
                    self._doubt.clear()
                    checked_s = loop.time()
                    if not await self._still_ours():
                        return False
                letters = await self._functions.mailbox.pending(self.agent, limit=AT_ONCE)
            except (StoreError, Problem) as error:
                _log.warning("mailbox of %s: %s", self.agent.id, error)
                await asyncio.sleep(LOOK_S)
                continue
            now_s = loop.time()
            alone = not self._broker_up()
            sent_s = {letter.command: sent_s[letter.command] for letter in letters if letter.command in sent_s}
            for letter in letters:
                late = seen is None or alone or letter.command in seen
                if late and now_s - sent_s.get(letter.command, float("-inf")) >= LOOK_S:
                    sent_s[letter.command] = now_s
                    self._line.send(stanzas.message(self.jid, letter.topic, letter.payload))
            seen = {letter.command for letter in letters}
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_ALONE_S if alone else LOOK_S):
                    await self._doubt.wait()

    async def _is_back(self) -> bool:
        """Whether the agent has greeted another program of ours since."""
        try:
            row = await self._functions.tables.get(records.AGENTS, self.agent.id, "link")
        except StoreError:
            return False
        return row is not None and records.read(row, Link).session > self.greeting.session

    async def _still_ours(self) -> bool:
        _, now = await records.find(self._functions.tables, records.AGENTS, self.agent.id, "agent", Agent)
        if now is None or not now.claimed or now.transport != "xmpp":
            return False
        if (now.pairing, now.space) != (self.agent.pairing, self.agent.space):
            return False
        self.agent = now
        return True
