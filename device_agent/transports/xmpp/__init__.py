"""XMPP transport, on slixmpp."""

from device_agent.transports.xmpp.transport import XmppAccess, XmppTransport

__all__ = ["XmppAccess", "XmppTransport"]
