"""``python -m function_app xmpp``: the XMPP gateway of the cloud. Any number of instances may run."""

from function_app.entrypoints.xmpp.program import run_gateway

__all__ = ["run_gateway"]
