"""The XMPP gateway (``python -m function_app xmpp``). Several gateways may run concurrently."""

from function_app.entrypoints.xmpp.program import run_gateway

__all__ = ["run_gateway"]
