"""The XMPP gateway: routes stanzas of agents and operators to their sessions, and messages of the broker to agents.

An agent starts a session with its presence message; the newest session number is valid. The sender of a message is the
agent in the JID, which the XMPP server has authenticated.
"""

import asyncio
import logging
from collections.abc import Coroutine
from xml.etree.ElementTree import Element

import httpx

from device_agent.protocol import Presence, State, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import jids, stanzas
from device_agent.protocol.xmpp.stanzas import Delivery
from function_app.bootstrap import Functions
from function_app.domain.common.ids import AGENT_LENGTH
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent
from function_app.entrypoints.xmpp.agent_session import AgentSession
from function_app.entrypoints.xmpp.operators import Operators
from function_app.ports.broker_link import OpenLink
from function_app.ports.feeds import CommandFeed
from function_app.ports.tables import StoreError
from function_app.ports.xmpp_connection import XmppConnection
from function_app.services.storage import records
from function_app.services.telemetry.ingest import InboundMessage

STORE_INTERVAL_S = 2.0
MAX_MEASUREMENTS = 20_000
"""Limit of measurements that wait for storage: a hundred robots at 20 Hz for ten seconds."""
MAX_ATTEMPTS = 3

_log = logging.getLogger(__name__)


class XmppGateway:
    """Serves agents as the listener of an ``XmppConnection`` and of the broker's command feed."""

    def __init__(
        self,
        functions: Functions,
        connection: XmppConnection,
        feed: CommandFeed,
        *,
        api: httpx.AsyncClient,
        open_link: OpenLink,
    ) -> None:
        self._functions = functions
        self._connection = connection
        self._feed = feed
        self._sessions: dict[str, AgentSession] = {}
        self._viewers: dict[str, set[str]] = {}
        self._operators = Operators(connection, api, open_link, self._start)
        self._tasks: set[asyncio.Task[None]] = set()
        self._measurements: list[InboundMessage] = []
        self._dropped = 0

    async def run(self) -> None:
        """Run until cancelled. Messages that were received before are stored first."""
        tasks = [
            asyncio.create_task(self._connection.run(self)),
            asyncio.create_task(self._feed.run(self.deliver)),
            asyncio.create_task(self._store_measurements()),
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
        user, resource = stanzas.user_at(jid, self._connection.domain) or ("", "")
        if not resource or user == jids.CLOUD:
            return
        if len(user) != AGENT_LENGTH:
            self._operators.receive(jid, user, stanza)
            return
        try:
            delivery = stanzas.parse(stanza)
        except ProtocolError as error:
            _log.warning("rejected a message of %s: %s", user, error)
            if stanza.get("id") and stanza.get("type") != "error":
                self._connection.send(stanzas.rejection(jid, stanza.get("id", ""), str(error)))
            return
        if delivery is None:
            return
        session = self._sessions.get(user)
        presence = _online_presence(delivery, user)
        if presence is not None and (session is None or session.presence.session != presence.session):
            self._start(self._start_session(user, jid, delivery, presence, stanzas.requested_topics(stanza)))
        elif session is not None and session.jid == jid:
            session.receive(delivery)
        elif delivery.id:
            # An agent without a session gets "unavailable", and then starts a session.
            self._connection.send(stanzas.presence(to=jid, available=False))

    def presence(self, stanza: Element) -> None:
        """See ``Listener``."""
        jid = stanza.get("from", "")
        identity = stanzas.user_at(jid, self._connection.domain)
        if identity is None or identity[0] == jids.CLOUD or stanza.get("type") not in {None, "unavailable"}:
            return
        user, available = identity[0], stanza.get("type") is None
        if len(user) == AGENT_LENGTH:
            session = self._sessions.get(user)
            if not available and session is not None and session.jid == jid:
                session.close()
        elif available and identity[1]:
            self._viewers.setdefault(user, set()).add(jid)
        else:
            self._operators.left(jid)
            self._viewers.get(user, set()).discard(jid)
            if not self._viewers.get(user):
                self._viewers.pop(user, None)

    def lost(self) -> None:
        """See ``Listener``."""
        self._viewers.clear()
        self._operators.lost()
        for session in self._sessions.values():
            session.close()

    def deliver(self, topic: str, payload: bytes) -> None:
        """Pass a message of the broker to the sessions that receive its topic."""
        parts = topic.split("/")
        if len(parts) > 5 and parts[5] == topics.TELE:  # noqa: PLR2004 (ts/v1/space/agent/device/tele/…)
            for subscriber in self._sessions.values():
                if topic in subscriber.subscriptions:
                    subscriber.send(topic, payload)
            return
        session = self._sessions.get(parts[3]) if len(parts) > 4 else None  # noqa: PLR2004 (ts/v1/space/agent/…)
        if session is None or parts[2] != session.agent.space:
            return
        if parts[4] != topics.CONN:
            session.send(topic, payload)
        elif not payload:
            session.request_check()  # the cloud clears retained messages when an agent is unpaired or moved
        else:
            self._restore_presence(session, payload)

    @staticmethod
    def _restore_presence(session: AgentSession, payload: bytes) -> None:
        """Publish the presence again if a late "offline" of an older session has replaced it at the broker."""
        try:
            retained = codec.decode(payload, Presence)
        except ProtocolError:
            return
        if not retained.online and retained.session < session.presence.session:
            session.receive(session.delivery)

    # ------------------------------------------------------------ agents

    async def _start_session(
        self, user: str, jid: str, delivery: Delivery, presence: Presence, requested: tuple[str, ...]
    ) -> None:
        try:
            agent = await self._find_agent(user)
        except (StoreError, Problem) as error:
            _log.warning("no session for %s: %s", user, error)
            self._connection.send(stanzas.presence(to=jid, available=False))
            return
        reason = _rejection_reason(agent, delivery)
        previous = self._sessions.get(user)
        if previous is not None and previous.presence.session > presence.session:
            reason = reason or "A newer session of this agent exists."
        if agent is None or reason is not None:
            if delivery.id:
                self._connection.send(stanzas.rejection(jid, delivery.id, reason or ""))
            return
        if previous is not None:
            previous.close(replaced=True)
        subscriptions = [topic for topic in requested if _may_subscribe(agent, topic)]
        session = self._sessions[user] = AgentSession(
            self._functions,
            self._connection,
            agent=agent,
            jid=jid,
            presence=presence,
            delivery=delivery._replace(id=""),
            subscriptions=subscriptions,
            broker_up=lambda: self._feed.up,
            on_measurement=self._collect,
            on_stored=self._notify_viewers,
        )
        session.receive(delivery)
        await self._feed.add(agent.space or "", agent.id, subscriptions)
        self._start(self._run_session(session))

    async def _find_agent(self, user: str) -> Agent | None:
        for attempt in range(MAX_ATTEMPTS):
            try:
                row = await self._functions.tables.get(records.AGENTS, user, "agent")
            except StoreError:
                if attempt + 1 == MAX_ATTEMPTS:
                    raise
                await asyncio.sleep(0.2)
                continue
            return None if row is None else records.read(row, Agent)
        return None

    async def _run_session(self, session: AgentSession) -> None:
        agent = session.agent
        _log.info("%s connected, session %d", agent.id, session.presence.session)
        try:
            authorized = await session.run()
        except Exception:  # noqa: BLE001 (other sessions continue; this agent starts a new one)
            _log.exception("the session of %s failed", agent.id)
            self._connection.send(stanzas.presence(to=session.jid, available=False))
            authorized = True
        if self._sessions.get(agent.id) is session:
            del self._sessions[agent.id]
            self._feed.drop(agent.space or "", agent.id)
        if not authorized:
            self._connection.send(stanzas.revoke_user(self._connection.domain, agent.id))
        _log.info("%s disconnected, session %d", agent.id, session.presence.session)

    def _start(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # ------------------------------------------------------------ viewers and measurements

    def _notify_viewers(self, agent: Agent, delivery: Delivery) -> None:
        """Send the state of a device to the owner's XMPP clients."""
        clients = self._viewers.get(agent.account or "")
        if not clients or not delivery.topic.endswith(f"/{topics.STATE}"):
            return
        try:
            state = codec.decode(delivery.payload, State)
        except ProtocolError:
            return
        body = f"{state.device}: {state.mode.value}" + (f", stopped by {state.stop.caller}" if state.stop else "")
        for jid in clients:
            self._connection.send(stanzas.message(jid, delivery.topic, delivery.payload, body=body))

    def _collect(self, measurement: InboundMessage) -> None:
        if len(self._measurements) >= MAX_MEASUREMENTS:
            self._dropped += 1
        else:
            self._measurements.append(measurement)

    async def _store_measurements(self) -> None:
        while True:
            await asyncio.sleep(STORE_INTERVAL_S)
            batch, self._measurements = self._measurements, []
            if self._dropped:
                _log.warning("telemetry storage is too slow: dropped %d messages", self._dropped)
                self._dropped = 0
            try:
                await self._functions.telemetry_ingest.ingest(batch)
            except Exception as error:  # noqa: BLE001 (later messages are still processed)
                _log.warning("%d measurements were not stored: %s", len(batch), error)


def _online_presence(delivery: Delivery, user: str) -> Presence | None:
    if not delivery.topic.endswith(f"/{user}/{topics.CONN}"):
        return None
    try:
        presence = codec.decode(delivery.payload, Presence)
    except ProtocolError:
        return None
    return presence if presence.online else None


def _may_subscribe(agent: Agent, topic: str) -> bool:
    """Whether the topic is telemetry of the agent's space."""
    try:
        parsed = topics.parse(topic)
    except ProtocolError:
        return False
    return parsed.space == agent.space and parsed.kind == topics.TELE


def _rejection_reason(agent: Agent | None, delivery: Delivery) -> str | None:
    """Why an agent may not start a session; ``None``: it may."""
    if agent is None or not agent.claimed:
        return "This agent is not claimed. Claim it with its code first."
    if agent.transport != "xmpp":
        return f"This agent is enrolled with the transport {agent.transport}. Enroll it with xmpp."
    if delivery.topic != topics.conn(agent.space or "", agent.id):
        return "This agent belongs to another space."
    return None
