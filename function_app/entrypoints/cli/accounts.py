"""Prints sign-in links and API keys."""

import argparse
from typing import Any

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity, Role
from function_app.entrypoints.cli import with_functions
from function_app.services.accounts.api_keys import ApiKeyRequest
from function_app.settings import SettingsError


def add_commands(commands: Any) -> None:
    """Add ``sign-in-link`` and ``api-key``."""
    text = "print a one-time sign-in link; creates the account if it does not exist"
    link = commands.add_parser("sign-in-link", help=text, description=text)
    link.add_argument("--account", default="demo", help="name of the account (default: %(default)s)")
    link.add_argument(
        "--remove-second-factor",
        action="store_true",
        help="remove the account's second factor, after the loss of its app and recovery codes",
    )
    link.set_defaults(run=with_functions(_sign_in_link))
    text = "print a new API key of an account, for another program"
    key = commands.add_parser("api-key", help=text, description=text)
    key.add_argument("--account", default="demo", help="name of the account (default: %(default)s)")
    key.add_argument("--name", required=True, help="purpose of the key; shown with the account in the audit log")
    key.add_argument("--role", choices=("viewer", "operator"), default="viewer", help="(default: %(default)s)")
    key.add_argument(
        "--only", action="append", default=[], metavar="DEVICE", help="id of a device, or space:ID; repeatable"
    )
    key.add_argument("--days", type=int, default=90, help="validity in days (default: %(default)s)")
    key.set_defaults(run=with_functions(_api_key))


async def _sign_in_link(functions: Functions, options: argparse.Namespace) -> None:
    try:
        account = await functions.sign_in.account(options.account)
        if options.remove_second_factor:
            await functions.second_factor.remove(account)
    except Problem as problem:
        raise SettingsError(problem.detail) from problem
    print(f"{functions.settings.public_url}/#sign-in={await functions.sign_in.link(account)}")


async def _api_key(functions: Functions, options: argparse.Namespace) -> None:
    request = ApiKeyRequest(label=options.name, most=Role(options.role), only=tuple(options.only), days=options.days)
    try:
        account = await functions.sign_in.account(options.account)
        _, token = await functions.api_keys.make(Identity(account.id, account.name, "terminal"), request)
    except Problem as problem:
        raise SettingsError(problem.detail) from problem
    print(token)
