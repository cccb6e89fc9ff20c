"""The operators that are signed in at one gateway."""

import logging
from collections.abc import Callable
from xml.etree.ElementTree import Element

import httpx

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.xmpp import operator_stanzas, stanzas
from device_agent.protocol.xmpp.operator_stanzas import SignIn
from function_app.entrypoints.xmpp.operator_session import OperatorSession
from function_app.ports.broker_link import OpenLink
from function_app.ports.xmpp_connection import XmppConnection

MAX_SESSIONS = 200
"""Operators at one gateway; each needs two or more broker connections."""
_log = logging.getLogger(__name__)


class Operators:
    """Passes stanzas of accounts to their sessions. A session starts with a sign-in.

    Args:
        connection: Connection to the XMPP server.
        api: The HTTP API, in this process.
        open_link: Opens a broker connection.
        start: Runs a coroutine in the background.
    """

    def __init__(
        self, connection: XmppConnection, api: httpx.AsyncClient, open_link: OpenLink, start: Callable[..., None]
    ) -> None:
        self._connection = connection
        self._api = api
        self._open_link = open_link
        self._start = start
        self._sessions: dict[str, OperatorSession] = {}

    def receive(self, jid: str, account: str, stanza: Element) -> None:
        """Handle a message of an account."""
        try:
            request = operator_stanzas.parse_request(stanza)
            delivery = stanzas.parse(stanza) if request is None else None
            session = self._sessions.get(jid)
            if request is not None:
                if session is None:
                    session = self._open(jid, account, keep=isinstance(request, SignIn))
                session.receive(request)
            elif delivery is not None and session is not None:
                session.receive_setpoint(delivery)
        except ProtocolError as error:
            _log.warning("rejected a message of %s: %s", account, error)
            if stanza.get("id") and stanza.get("type") != "error":
                self._connection.send(stanzas.rejection(jid, stanza.get("id", ""), str(error)))

    def left(self, jid: str) -> None:
        """An operator has disconnected."""
        session = self._sessions.pop(jid, None)
        if session is not None:
            self._start(session.close())

    def lost(self) -> None:
        """The connection to the XMPP server was lost."""
        for jid in list(self._sessions):
            self.left(jid)

    def _open(self, jid: str, account: str, *, keep: bool) -> OperatorSession:
        session = OperatorSession(self._connection, self._api, self._open_link, jid=jid, account=account)
        if keep:
            while len(self._sessions) >= MAX_SESSIONS:
                self.left(next(iter(self._sessions)))
            self._sessions[jid] = session
        return session
