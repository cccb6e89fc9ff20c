"""The program, from start to end."""

import asyncio
import signal

from function_app.bootstrap import Functions
from function_app.bootstrap.xmpp import command_feed, xmpp_connection
from function_app.entrypoints.xmpp.gateway import XmppGateway


async def run_gateway(functions: Functions) -> None:
    """Run until SIGINT or SIGTERM.

    Raises:
        StoreError: The tables cannot be used, at the start.
        SettingsError: There is no XMPP server in the settings.
    """
    ending = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ending.set)
    await functions.health.require_tables()
    gateway = XmppGateway(functions, xmpp_connection(functions), command_feed(functions))
    running = asyncio.create_task(gateway.run())
    waiting = asyncio.create_task(ending.wait())
    done, _ = await asyncio.wait((running, waiting), return_when=asyncio.FIRST_COMPLETED)
    for task in (running, waiting):
        task.cancel()
    await asyncio.gather(running, waiting, return_exceptions=True)
    if running in done:
        running.result()
