"""The connection of the cloud to the XMPP server."""

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element  # imported only by programs that use XMPP


class Listener(Protocol):
    """Receives stanzas on the event loop; must not block."""

    def message(self, stanza: "Element") -> None:
        """Handle a ``<message>``."""

    def presence(self, stanza: "Element") -> None:
        """Handle a ``<presence>``."""

    def lost(self) -> None:
        """The connection was lost; the presence of all contacts is unknown."""


class XmppConnection(Protocol):
    """One connection to the XMPP server. Messages sent while disconnected are dropped.

    Example::

        await connection.run(listener)
    """

    @property
    def domain(self) -> str:
        """The domain part of every JID."""

    async def run(self, listener: Listener) -> None:
        """Stay connected until cancelled; reconnects without limit."""

    def send(self, stanza: str) -> bool:
        """Send a stanza; returns ``False`` and drops it if there is no connection."""

    def congested(self) -> bool:
        """Whether the send queue is full, so that expendable messages should be dropped."""
