"""Who speaks for the cloud over XMPP: knows who is there, and hands each stanza and order to whom it is about.

An agent is served once it has greeted with its presence message; its newest greeting counts. What an agent tells it
publishes for itself: its name is that of its JID, which the XMPP server has verified.
"""

import asyncio
import logging
from collections.abc import Coroutine
from xml.etree.ElementTree import Element

from device_agent.protocol import Presence, State, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import jids, stanzas
from device_agent.protocol.xmpp.stanzas import Delivery
from function_app.bootstrap import Functions
from function_app.domain.common.ids import AGENT_LENGTH
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent
from function_app.entrypoints.xmpp.agent_session import AgentSession
from function_app.ports.command_feed import CommandFeed
from function_app.ports.tables import StoreError
from function_app.ports.xmpp_connection import XmppConnection
from function_app.services.storage import records
from function_app.services.telemetry.ingest import InboundMessage

COLLECT_S = 2.0
MAX_COLLECTED = 20_000
"""Measurements that wait to be stored: a hundred robots at 20 Hz for ten seconds."""
GREET_TRIES = 3

_log = logging.getLogger(__name__)


class XmppGateway:
    """Listener of an ``XmppConnection``; also passes on the commands of the broker."""

    def __init__(self, functions: Functions, line: XmppConnection, orders: CommandFeed) -> None:
        self._functions = functions
        self._line = line
        self._orders = orders
        self._served: dict[str, AgentSession] = {}
        self._people: dict[str, set[str]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._collected: list[InboundMessage] = []
        self._dropped = 0

    async def run(self) -> None:
        """Speak until cancelled; then what was told already is stored still."""
        tasks = [
            asyncio.create_task(self._line.run(self)),
            asyncio.create_task(self._orders.run(self.order)),
            asyncio.create_task(self._keep_measurements()),
        ]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self.lost()
            if self._tasks:
                await asyncio.wait(self._tasks, timeout=2.0)

    # ------------------------------------------------------------ received stanzas

    def message(self, stanza: Element) -> None:
        """See ``Listener``."""
        jid = stanza.get("from", "")
        user = self._agent_at(jid)
        if user is None:
            return
        try:
            told = stanzas.parse(stanza)
        except ProtocolError as error:
            _log.warning("a message of %s was refused: %s", user, error)
            if stanza.get("id") and stanza.get("type") != "error":
                self._line.send(stanzas.rejection(jid, stanza.get("id", ""), str(error)))
            return
        if told is None:
            return
        served = self._served.get(user)
        greeting = _greeting(told, user)
        if greeting is not None and (served is None or served.greeting.session != greeting.session):
            self._start(self._greeted(user, jid, told, greeting, stanzas.requested_topics(stanza)))
        elif served is not None and served.jid == jid:
            served.say(told)
        elif told.id:
            # An agent without a session gets "unavailable", and then starts a session.
            self._line.send(stanzas.presence(to=jid, available=False))

    def presence(self, stanza: Element) -> None:
        """See ``Listener``."""
        jid = stanza.get("from", "")
        found = stanzas.user_at(jid, self._line.domain)
        if found is None or found[0] == jids.CLOUD or stanza.get("type") not in {None, "unavailable"}:
            return
        user, there = found[0], stanza.get("type") is None
        if len(user) == AGENT_LENGTH:
            served = self._served.get(user)
            if not there and served is not None and served.jid == jid:
                served.leave()
        elif there and found[1]:
            self._people.setdefault(user, set()).add(jid)
        else:
            self._people.get(user, set()).discard(jid)
            if not self._people.get(user):
                self._people.pop(user, None)

    def lost(self) -> None:
        """See ``Listener``."""
        self._people.clear()
        for served in self._served.values():
            served.leave()

    def order(self, topic: str, payload: bytes) -> None:
        """Something came by the broker."""
        parts = topic.split("/")
        if len(parts) > 5 and parts[5] == topics.TELE:  # noqa: PLR2004 (ts/v1/space/agent/device/tele/…)
            for listener in self._served.values():
                if topic in listener.listen:
                    listener.order(topic, payload)
            return
        served = self._served.get(parts[3]) if len(parts) > 4 else None  # noqa: PLR2004 (ts/v1/space/agent/…)
        if served is None or parts[2] != served.agent.space:
            return
        if parts[4] != topics.CONN:
            served.order(topic, payload)
        elif not payload:
            served.doubt()  # what was kept of it was cleared: it is leaving
        else:
            self._contradict(served, payload)

    @staticmethod
    def _contradict(served: AgentSession, payload: bytes) -> None:
        """An older connection was declared gone after this one had come, and that is what the broker keeps now."""
        try:
            said = codec.decode(payload, Presence)
        except ProtocolError:
            return
        if not said.online and said.session < served.greeting.session:
            served.say(served.greeted)

    # ------------------------------------------------------------ agents

    def _agent_at(self, jid: str) -> str | None:
        found = stanzas.user_at(jid, self._line.domain)
        return found[0] if found is not None and found[1] and len(found[0]) == AGENT_LENGTH else None

    async def _greeted(self, user: str, jid: str, told: Delivery, greeting: Presence, wanted: tuple[str, ...]) -> None:
        try:
            agent = await self._known(user)
        except (StoreError, Problem) as error:
            _log.warning("%s cannot be served: %s", user, error)
            self._line.send(stanzas.presence(to=jid, available=False))
            return
        why = _unfit(agent, told)
        before = self._served.get(user)
        if before is not None and before.greeting.session > greeting.session:
            why = why or "A newer connection of this agent is there."
        if agent is None or why is not None:
            if told.id:
                self._line.send(stanzas.rejection(jid, told.id, why or ""))
            return
        if before is not None:
            before.leave(replaced=True)
        listen = [topic for topic in wanted if _may_hear(agent, topic)]
        served = self._served[user] = AgentSession(
            self._functions,
            self._line,
            agent=agent,
            jid=jid,
            greeting=greeting,
            greeted=told._replace(id=""),
            listen=listen,
            broker_up=lambda: self._orders.up,
            measured=self._measured,
            told=self._show,
        )
        served.say(told)
        await self._orders.add(agent.space or "", agent.id, listen)
        self._start(self._serve(served))

    async def _known(self, user: str) -> Agent | None:
        for attempt in range(GREET_TRIES):
            try:
                row = await self._functions.tables.get(records.AGENTS, user, "agent")
            except StoreError:
                if attempt + 1 == GREET_TRIES:
                    raise
                await asyncio.sleep(0.2)
                continue
            return None if row is None else records.read(row, Agent)
        return None

    async def _serve(self, served: AgentSession) -> None:
        agent = served.agent
        _log.info("%s is there, session %d", agent.id, served.greeting.session)
        try:
            welcome = await served.run()
        except Exception:  # noqa: BLE001 (the others go on; this one greets anew)
            _log.exception("%s is served no longer", agent.id)
            self._line.send(stanzas.presence(to=served.jid, available=False))
            welcome = True
        if self._served.get(agent.id) is served:
            del self._served[agent.id]
            self._orders.drop(agent.space or "", agent.id)
        if not welcome:
            self._line.send(stanzas.revoke_user(self._line.domain, agent.id))
        _log.info("%s is gone, session %d", agent.id, served.greeting.session)

    def _start(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # ------------------------------------------------------------ people, and what is measured

    def _show(self, agent: Agent, told: Delivery) -> None:
        """A person who is there with an XMPP client of their own hears how their devices are."""
        places = self._people.get(agent.account or "")
        if not places or not told.topic.endswith(f"/{topics.STATE}"):
            return
        try:
            said = codec.decode(told.payload, State)
        except ProtocolError:
            return
        body = f"{said.device}: {said.mode.value}" + (f", stopped by {said.stop.caller}" if said.stop else "")
        for jid in places:
            self._line.send(stanzas.message(jid, told.topic, told.payload, body=body))

    def _measured(self, arrived: InboundMessage) -> None:
        if len(self._collected) >= MAX_COLLECTED:
            self._dropped += 1
        else:
            self._collected.append(arrived)

    async def _keep_measurements(self) -> None:
        while True:
            await asyncio.sleep(COLLECT_S)
            batch, self._collected = self._collected, []
            if self._dropped:
                _log.warning("telemetry is behind: %d messages were dropped", self._dropped)
                self._dropped = 0
            try:
                await self._functions.telemetry_ingest.ingest(batch)
            except Exception as error:  # noqa: BLE001 (later messages are still processed)
                _log.warning("%d measurements were not stored: %s", len(batch), error)


def _greeting(told: Delivery, user: str) -> Presence | None:
    if not told.topic.endswith(f"/{user}/{topics.CONN}"):
        return None
    try:
        said = codec.decode(told.payload, Presence)
    except ProtocolError:
        return None
    return said if said.online else None


def _may_hear(agent: Agent, topic: str) -> bool:
    """What any agent may hear: what its space measures."""
    try:
        parsed = topics.parse(topic)
    except ProtocolError:
        return False
    return parsed.space == agent.space and parsed.kind == topics.TELE


def _unfit(agent: Agent | None, told: Delivery) -> str | None:
    """Why an agent cannot be served."""
    if agent is None or not agent.claimed:
        return "This agent is not claimed. Claim it with its code first."
    if agent.transport != "xmpp":
        return f"This agent said at its enrolment that it speaks {agent.transport}. Enroll it for xmpp."
    if told.topic != topics.conn(agent.space or "", agent.id):
        return "This agent belongs to another space now."
    return None
