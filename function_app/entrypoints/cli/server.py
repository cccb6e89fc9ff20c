"""Commands that run the server's processes, and that prepare cloud resources."""

import argparse
import asyncio
import contextlib
import logging
import os
from collections.abc import Iterator
from typing import Any

from function_app import settings
from function_app.adapters import factory
from function_app.adapters.local.installation import lock
from function_app.adapters.local.table_file import FILE_NAME
from function_app.bootstrap import Functions
from function_app.entrypoints.cli import build, with_functions
from function_app.entrypoints.hosts import worker
from function_app.settings import SettingsError

_WORKER_NICE = 5
"""HTTP responses, and an agent on the same machine, have priority over storage."""

_MAX_CHECKED_BYTES = 500_000_000
"""Size of the tables up to which all rows are checked before the start, which takes about six seconds."""
_log = logging.getLogger(__name__)


def add_commands(commands: Any) -> None:
    """Add ``serve``, ``work``, ``xmpp``, ``prepare`` and ``check-models``."""
    for name, run, text in (
        ("serve", _serve, "serve the API and the console with uvicorn"),
        ("work", with_functions(_work), "store messages from the broker and run timers"),
        ("xmpp", with_functions(_xmpp), "connect agents that use XMPP"),
        ("prepare", _prepare, "create the vault secret, DynamoDB table and S3 bucket that do not exist yet"),
    ):
        command = commands.add_parser(name, help=text, description=text)
        command.set_defaults(run=run)
        if name == "work":
            command.add_argument("--metrics", type=int, metavar="PORT", help="serve metrics at this port of 127.0.0.1")
    text = "compile uploaded robot types with MuJoCo; `work` does this too"
    checks = commands.add_parser("check-models", help=text, description=text)
    checks.add_argument("--drain", action="store_true", help="exit when no upload is left")
    checks.set_defaults(run=with_functions(_check_models))


def _serve(_: argparse.Namespace) -> int:
    from function_app.entrypoints.hosts import uvicorn  # noqa: PLC0415 (cloud packages do not contain it)

    functions = build()
    with _using(functions):
        asyncio.run(_check(functions))
        uvicorn.serve(functions)
    return 0


@contextlib.contextmanager
def _using(functions: Functions) -> Iterator[None]:
    """Prevent that a backup is restored while this program runs."""
    if functions.settings.store is not None:
        yield
        return
    try:
        with lock.in_use(functions.settings.home):
            yield
    except lock.InUse as error:
        raise SettingsError(f"a backup is being restored to {error}; start again afterwards") from error


async def _check(functions: Functions) -> None:
    """Report unavailable tables or keys at the start instead of at the first request."""
    await functions.health.require_tables()
    tables = functions.settings.home / FILE_NAME
    thorough = functions.settings.store is None and tables.stat().st_size <= _MAX_CHECKED_BYTES
    if functions.settings.store is None and not thorough:
        _log.warning("%s is too large for a check at each start; run `telescope-server verify`", tables)
    for problem in await functions.tables.check(thorough=thorough):
        _log.error("%s", problem)
    await functions.keys.current()
    await functions.tables.close()


def _prepare(_: argparse.Namespace) -> int:
    asyncio.run(factory.prepare(settings.read()))
    return 0


async def _work(functions: Functions, options: argparse.Namespace) -> None:
    if options.metrics:
        try:
            functions.metrics.serve(options.metrics)
        except OSError as error:
            raise SettingsError(f"--metrics {options.metrics}: {error}") from error
    if hasattr(os, "nice"):
        os.nice(_WORKER_NICE)
    with _using(functions):
        await worker.work(functions)


async def _xmpp(functions: Functions, _: argparse.Namespace) -> None:
    try:
        from function_app.entrypoints.xmpp import run_gateway  # noqa: PLC0415 (slixmpp is optional)

        with _using(functions):
            await run_gateway(functions)
    except ModuleNotFoundError as error:
        raise SettingsError(f"the XMPP gateway needs the Python package {error.name}; run `make env`") from error


async def _check_models(functions: Functions, options: argparse.Namespace) -> None:
    await worker.check_models(functions, drain=options.drain)
