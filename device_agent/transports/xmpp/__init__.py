"""XMPP through slixmpp: the agent is a user of an XMPP server, and speaks with the one user that is the cloud."""

from device_agent.transports.xmpp.transport import XmppAccess, XmppTransport

__all__ = ["XmppAccess", "XmppTransport"]
