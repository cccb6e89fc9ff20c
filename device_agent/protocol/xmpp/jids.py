"""Names on an XMPP server that both sides know: apart from stanzas, so that who only names somebody loads no XML."""

CLOUD = "cloud"
"""The user that speaks for the cloud, with a resource for each process that does."""
