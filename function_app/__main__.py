"""``python -m function_app serve|work|xmpp|check-models|prepare|sign-in-link``: the functions on one machine."""

import argparse
import asyncio
import logging
import sys
from collections.abc import Sequence

from function_app import bootstrap, choices, settings
from function_app.bootstrap import Functions
from function_app.entrypoints.serve import PortTaken, serve
from function_app.entrypoints.worker import check_models, work
from function_app.ports.model_compiler import CompilerMissingError
from function_app.ports.tables import StoreError

_EXIT_FAILED = 1
_EXIT_TAKEN = 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m function_app", description="The Telescope functions.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    commands.add_parser("serve", help="API and console, under uvicorn")
    commands.add_parser("work", help="ingest from the broker, and timers")
    commands.add_parser("xmpp", help="speak XMPP for the cloud, with agents that have chosen it")
    commands.add_parser("prepare", help="make Amazon's table and bucket, where there are none")
    checks = commands.add_parser("check-models", help="compile uploaded robot types with MuJoCo, as `work` does too")
    checks.add_argument("--drain", action="store_true", help="end as soon as none is left")
    link = commands.add_parser("sign-in-link", help="print a one-time sign-in link; makes the account if it is new")
    link.add_argument("--account", default="demo", help="name of the account (default: %(default)s)")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr)
    for sdk in ("azure", "botocore"):  # they tell of every request
        logging.getLogger(sdk).setLevel(logging.WARNING)
    try:
        known = settings.read()
        if options.command == "prepare":
            asyncio.run(choices.prepare(known))
            return 0
        functions = bootstrap.build(known)
        if options.command == "serve":
            asyncio.run(_check(functions))
            serve(functions)
        elif options.command == "work":
            asyncio.run(work(functions))
        elif options.command == "xmpp":
            asyncio.run(_speak(functions))
        elif options.command == "check-models":
            asyncio.run(_check_models(functions, drain=options.drain))
        else:
            asyncio.run(_link(functions, options.account))
    except PortTaken as taken:
        print(f"telescope functions: {taken}", file=sys.stderr)
        return _EXIT_TAKEN
    except (StoreError, CompilerMissingError, settings.SettingsError) as error:
        print(f"telescope functions: {error}", file=sys.stderr)
        return _EXIT_FAILED
    except KeyboardInterrupt:
        return 130
    return 0


async def _check(functions: Functions) -> None:
    """Say at once what is wrong with the tables, not at the first request."""
    await functions.health.require_tables()
    await functions.tables.close()


async def _check_models(functions: Functions, *, drain: bool) -> None:
    try:
        await check_models(functions, drain=drain)
    finally:
        await functions.close()


async def _speak(functions: Functions) -> None:
    from function_app.entrypoints.xmpp import speak  # noqa: PLC0415 (what it needs is not everywhere)

    try:
        await speak(functions)
    except ModuleNotFoundError as error:
        raise settings.SettingsError(f"speaking XMPP needs the Python package {error.name}; run `make env`") from error


async def _link(functions: Functions, account: str) -> None:
    found = await functions.sign_in.account(account)
    print(f"{functions.settings.public_url}/#sign-in={await functions.sign_in.link(found)}")
    await functions.close()


if __name__ == "__main__":
    sys.exit(main())
