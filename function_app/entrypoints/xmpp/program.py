"""The program, from start to end."""

import asyncio
import signal

from function_app.bootstrap import Functions
from function_app.bootstrap.xmpp import command_feed, xmpp_connection
from function_app.entrypoints.xmpp.gateway import XmppGateway


async def speak(functions: Functions) -> None:
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
    speaker = XmppGateway(functions, xmpp_connection(functions), command_feed(functions))
    speaking = asyncio.create_task(speaker.run())
    waiting = asyncio.create_task(ending.wait())
    done, _ = await asyncio.wait((speaking, waiting), return_when=asyncio.FIRST_COMPLETED)
    for task in (speaking, waiting):
        task.cancel()
    await asyncio.gather(speaking, waiting, return_exceptions=True)
    if speaking in done:
        speaking.result()
