"""``python -m function_app xmpp``: speaks XMPP for the cloud. Any number may run."""

from function_app.entrypoints.xmpp.program import speak

__all__ = ["speak"]
