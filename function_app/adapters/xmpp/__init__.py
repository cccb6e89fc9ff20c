"""The XMPP connection of the functions."""
