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
"""Operators at one gateway; each needs one broker connection, and one for each device under control."""
MAX_OF_ACCOUNT = 32
"""Sessions of one account at one gateway; a further sign-in ends the oldest. A page has one for each lease."""
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
                if session is None and isinstance(request, SignIn):
                    session = self._open(jid, account)
                if session is not None:
                    session.receive(request)
                else:
                    busy = isinstance(request, SignIn)
                    status, detail = (
                        (503, "This gateway is full. Try again later.") if busy else (401, "Sign in first.")
                    )
                    self._connection.send(operator_stanzas.problem(jid, request.id, status, detail))
            elif delivery is not None and session is not None:
                session.receive_setpoint(delivery)
            elif delivery is not None:  # its session was ended for a newer one
                self._connection.send(stanzas.rejection(jid, stanza.get("id", ""), "Sign in first."))
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

    def _open(self, jid: str, account: str) -> OperatorSession | None:
        """A new session; ``None``: the gateway is full."""
        own = [other for other in self._sessions if other.partition("@")[0] == account]
        if len(own) >= MAX_OF_ACCOUNT:
            self.left(own[0])
        if len(self._sessions) >= MAX_SESSIONS:
            return None
        session = OperatorSession(self._connection, self._api, self._open_link, jid=jid, account=account)
        self._sessions[jid] = session
        return session
