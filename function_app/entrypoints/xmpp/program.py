"""Runs the XMPP gateway as a program."""

import asyncio
import signal

import httpx
from starlette.types import ASGIApp

from function_app.bootstrap import Functions
from function_app.bootstrap.xmpp import broker_links, command_feed, xmpp_connection
from function_app.entrypoints.http.app import create_app
from function_app.entrypoints.xmpp.gateway import XmppGateway


async def run_gateway(functions: Functions) -> None:
    """Run until SIGINT or SIGTERM.

    Raises:
        StoreError: The tables are not available at the start.
        SettingsError: The settings name no XMPP server.
    """
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopping.set)
    await functions.health.require_tables()
    gateway = create_gateway(functions, create_app(functions))
    running = asyncio.create_task(gateway.run())
    waiting = asyncio.create_task(stopping.wait())
    done, _ = await asyncio.wait((running, waiting), return_when=asyncio.FIRST_COMPLETED)
    for task in (running, waiting):
        task.cancel()
    await asyncio.gather(running, waiting, return_exceptions=True)
    if running in done:
        running.result()


def create_gateway(functions: Functions, app: ASGIApp) -> XmppGateway:
    """The gateway; operators call ``app`` in this process."""
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)  # no timeout: the API limits waiting calls
    api = httpx.AsyncClient(transport=transport, base_url=functions.settings.public_url)
    return XmppGateway(
        functions, xmpp_connection(functions), command_feed(functions), api=api, open_link=broker_links(functions)
    )
