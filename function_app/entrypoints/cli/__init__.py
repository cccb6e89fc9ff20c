"""Commands of ``telescope-server``: each module adds its commands and runs them."""

import argparse
import asyncio
from collections.abc import Awaitable, Callable

from device_agent.protocol.security import private_folder
from function_app import bootstrap, settings
from function_app.bootstrap import Functions

AsyncCommand = Callable[[Functions, argparse.Namespace], Awaitable[int | None]]


def build() -> Functions:
    """The services of the environment's settings; other users lose their access to the server's folder."""
    configuration = settings.read()
    advice = "run `python -m function_app rotate-keys --leaked`"
    private_folder.restrict(configuration.home, advice=advice)
    return bootstrap.build(configuration)


def with_functions(command: AsyncCommand) -> Callable[[argparse.Namespace], int]:
    """A command that receives services built from the environment's settings. They are closed when it ends."""

    async def run(options: argparse.Namespace) -> int:
        functions = build()
        try:
            return await command(functions, options) or 0
        finally:
            await functions.close()

    return lambda options: asyncio.run(run(options))
