"""Routes of the polling transport and of XMPP."""
