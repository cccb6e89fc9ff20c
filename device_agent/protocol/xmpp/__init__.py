"""The wire contract over XMPP."""
