"""Commands of ``telescope-server``: each module adds its commands and runs them."""

import argparse
import asyncio
from collections.abc import Awaitable, Callable

from function_app import bootstrap, settings
from function_app.bootstrap import Functions

AsyncCommand = Callable[[Functions, argparse.Namespace], Awaitable[int | None]]


def with_functions(command: AsyncCommand) -> Callable[[argparse.Namespace], int]:
    """A command that receives services built from the environment's settings. They are closed when it ends."""

    async def run(options: argparse.Namespace) -> int:
        functions = bootstrap.build(settings.read())
        try:
            return await command(functions, options) or 0
        finally:
            await functions.close()

    return lambda options: asyncio.run(run(options))
