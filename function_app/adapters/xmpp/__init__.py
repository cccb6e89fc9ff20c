"""Xmpp."""
