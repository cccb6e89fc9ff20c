"""The cloud's own connection to the XMPP server."""

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element  # functions that speak no XMPP load no XML


class Listener(Protocol):
    """Who is told what comes; quick, on the event loop's own thread."""

    def message(self, stanza: "Element") -> None:
        """A ``<message>`` came."""

    def presence(self, stanza: "Element") -> None:
        """A ``<presence>`` came."""

    def lost(self) -> None:
        """The connection is gone: nobody is known to be there any more."""


class XmppConnection(Protocol):
    """One connection at a time."""

    @property
    def domain(self) -> str:
        """The part of every JID after the ``@``."""

    async def run(self, listener: Listener) -> None:
        """Be connected until cancelled; reconnects for ever."""

    def send(self, stanza: str) -> bool:
        """Write a stanza; ``False`` where there is no connection, and it is dropped."""

    def congested(self) -> bool:
        """Whether so much waits to be sent that what is worth nothing later had better be dropped."""
