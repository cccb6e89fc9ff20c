"""``python -m function_app COMMAND``: the functions, and what whoever runs them does at a terminal."""

import argparse
import asyncio
import logging
import os
import sys
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

from function_app import bootstrap, settings
from function_app.adapters import factory
from function_app.bootstrap import Functions
from function_app.domain.audit.hash_chain import CLOUD, AccountEvent
from function_app.domain.common.problems import Problem
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.identity.accounts import Identity, Role
from function_app.entrypoints.cli import audit
from function_app.entrypoints.hosts.uvicorn import PortTaken, serve
from function_app.entrypoints.hosts.worker import check_models, work
from function_app.ports.model_compiler import CompilerMissingError
from function_app.ports.signing_keys import LEARN_MS, OVERLAP_MS, RotationRefused
from function_app.ports.tables import StoreError
from function_app.services.accounts.api_keys import ApiKeyRequest

_EXIT_FAILED = 1
_WORKER_NICE = 5
"""What is stored may wait a moment; for an answer, and for a robot beside it on this machine, somebody waits."""
_MINUTE_MS = 60_000
_HOUR_MS = 60 * _MINUTE_MS
_LEAST_LEARN_MINUTES = 65
_LEAST_OVERLAP_HOURS = 24
_EXIT_TAKEN = 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m function_app", description="The Telescope functions.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    commands.add_parser("serve", help="API and console, under uvicorn")
    commands.add_parser("work", help="ingest from the broker, and timers")
    commands.add_parser("xmpp", help="speak XMPP for the cloud, with agents that have chosen it")
    commands.add_parser("prepare", help="make a vault's secret, Amazon's table and bucket, where there are none")
    checks = commands.add_parser("check-models", help="compile uploaded robot types with MuJoCo, as `work` does too")
    checks.add_argument("--drain", action="store_true", help="end as soon as none is left")
    rotate = commands.add_parser("rotate-keys", help="make a new signing key; the present one counts on for a while")
    rotate.add_argument(
        "--learn-minutes",
        type=int,
        default=LEARN_MS // _MINUTE_MS,
        metavar="N",
        help="orders to devices are signed with it after so long (default: %(default)s; at least 65)",
    )
    rotate.add_argument(
        "--overlap-hours",
        type=int,
        default=OVERLAP_MS // _HOUR_MS,
        metavar="N",
        help="how long the present key counts beside it (default: %(default)s; at least 24)",
    )
    rotate.add_argument(
        "--leaked", action="store_true", help="the present key ends at once; everybody signs in and every agent repins"
    )
    link = commands.add_parser("sign-in-link", help="print a one-time sign-in link; makes the account if it is new")
    link.add_argument("--account", default="demo", help="name of the account (default: %(default)s)")
    audit.add_command(commands)
    key = commands.add_parser("api-key", help="print a new API key of an account, for a program of somebody else's")
    key.add_argument("--account", default="demo", help="name of the account (default: %(default)s)")
    key.add_argument("--name", required=True, help="what it is for; shown beside the account wherever it acts")
    key.add_argument("--role", choices=("viewer", "operator"), default="viewer", help="(default: %(default)s)")
    key.add_argument("--only", action="append", default=[], metavar="DEVICE", help="a device's id, or space:ID; repeat")
    key.add_argument("--days", type=int, default=90, help="how long it is good for (default: %(default)s)")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr)
    for sdk in ("azure", "botocore"):  # they tell of every request
        logging.getLogger(sdk).setLevel(logging.WARNING)
    try:
        known = settings.read()
        if options.command == "prepare":
            asyncio.run(factory.prepare(known))
            return 0
        functions = bootstrap.build(known)
        if options.command == "serve":
            asyncio.run(_check(functions))
            serve(functions)
        else:
            return asyncio.run(_COMMANDS[options.command](functions, options)) or 0
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
    await functions.keys.current()
    await functions.tables.close()


async def _work(functions: Functions, _: argparse.Namespace) -> None:
    if hasattr(os, "nice"):
        os.nice(_WORKER_NICE)
    await work(functions)


async def _check_models(functions: Functions, options: argparse.Namespace) -> None:
    try:
        await check_models(functions, drain=options.drain)
    finally:
        await functions.close()


async def _speak(functions: Functions, _: argparse.Namespace) -> None:
    from function_app.entrypoints.xmpp import speak  # noqa: PLC0415 (what it needs is not everywhere)

    try:
        await speak(functions)
    except ModuleNotFoundError as error:
        raise settings.SettingsError(f"speaking XMPP needs the Python package {error.name}; run `make env`") from error


async def _rotate(functions: Functions, options: argparse.Namespace) -> None:
    learn_ms, overlap_ms = options.learn_minutes * _MINUTE_MS, options.overlap_hours * _HOUR_MS
    if options.learn_minutes < _LEAST_LEARN_MINUTES or options.overlap_hours < _LEAST_OVERLAP_HOURS:
        raise settings.SettingsError(
            f"--learn-minutes must be {_LEAST_LEARN_MINUTES} or more (agents ask once an hour), --overlap-hours "
            f"{_LEAST_OVERLAP_HOURS} or more (sign-ins live for 12)"
        )
    if learn_ms >= overlap_ms:
        raise settings.SettingsError("--learn-minutes must be less than --overlap-hours")
    try:
        news = await functions.keys.rotate(learn_ms=learn_ms, overlap_ms=overlap_ms, leaked=options.leaked)
        key = news.pins[-1].id
        await functions.audit_log.record(CLOUD, AccountEvent.SIGNING_KEY_ROTATED, None, on=key, leaked=options.leaked)
    except RotationRefused as refused:
        raise settings.SettingsError(
            f"devices are still learning the last new key, until {rfc3339(refused.until_ms)}; wait, or say --leaked"
        ) from refused
    finally:
        await functions.close()
    new = news.pins[-1]
    print(f"new key {new.id}, number {new.serial}")
    if options.leaked:
        print("all former keys have ended; sign in again, and run `python -m device_agent repin` at every agent")
    else:
        ends_ms = max(pin.until_ms for pin in news.pins)
        print(f"orders to devices are signed with it in {options.learn_minutes} minutes; agents learn it until then")
        print(f"the former key counts until {rfc3339(ends_ms)}; an agent that is off until then must `repin`")


async def _link(functions: Functions, options: argparse.Namespace) -> None:
    found = await functions.sign_in.account(options.account)
    print(f"{functions.settings.public_url}/#sign-in={await functions.sign_in.link(found)}")
    await functions.close()


async def _api_key(functions: Functions, options: argparse.Namespace) -> None:
    account = await functions.sign_in.account(options.account)
    wanted = ApiKeyRequest(label=options.name, most=Role(options.role), only=tuple(options.only), days=options.days)
    try:
        _, token = await functions.api_keys.make(Identity(account.id, account.name, "terminal"), wanted)
    except Problem as problem:
        raise settings.SettingsError(problem.detail) from problem
    finally:
        await functions.close()
    print(token)


_COMMANDS: dict[str, Callable[[Functions, argparse.Namespace], Coroutine[Any, Any, int | None]]] = {
    "audit": audit.run,
    "work": _work,
    "xmpp": _speak,
    "check-models": _check_models,
    "rotate-keys": _rotate,
    "sign-in-link": _link,
    "api-key": _api_key,
}

if __name__ == "__main__":
    sys.exit(main())
