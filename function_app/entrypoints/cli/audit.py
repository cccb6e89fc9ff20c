"""Verifies the audit log's hash chains and prints their heads."""

import argparse
from typing import Any

from function_app.bootstrap import Functions
from function_app.domain.audit.hash_chain import CLOUD, Head, parse_head
from function_app.entrypoints.cli import with_functions
from function_app.ports.tables import StoreError

_EXIT_BROKEN = 1
_EXIT_USAGE = 2


def add_commands(commands: Any) -> None:
    """Add ``audit verify`` and ``audit head``."""
    text = "verify the audit log"
    verbs = commands.add_parser("audit", help=text, description=text).add_subparsers(required=True, metavar="VERB")
    for verb, run, description in (
        ("verify", _verify, "verify every record; prints the first invalid record of each chain"),
        ("head", _head, "print the head of each chain, to be stored elsewhere and passed to verify with --expect"),
    ):
        parser = verbs.add_parser(verb, help=description, description=description)
        parser.add_argument("--account", help=f"name or id of one account, or '{CLOUD}' (default: all)")
        if verb == "verify":
            parser.add_argument(
                "--expect",
                action="append",
                default=[],
                metavar="SEQ:HASH",
                help="a head of --account that was stored elsewhere; repeatable",
            )
        parser.set_defaults(run=with_functions(run))


async def _head(functions: Functions, options: argparse.Namespace) -> None:
    for chain in await _chains(functions, options.account):
        print(f"{chain} {await functions.audit_reader.head(chain) or 'has no records'}")


async def _verify(functions: Functions, options: argparse.Namespace) -> int:
    expected = [parse_head(text) for text in options.expect]
    if None in expected:
        print("--expect must be a number, a colon and 64 hexadecimal digits, as `audit head` prints it")
        return _EXIT_USAGE
    if expected and options.account is None:
        print("--expect needs --account: name the account whose head it is")
        return _EXIT_USAGE
    broken = False
    heads = tuple(head for head in expected if isinstance(head, Head))
    for chain in await _chains(functions, options.account):
        verdict = await functions.audit_reader.verify(chain, expected=heads)
        result = f"OK {chain} {verdict.head}"
        if verdict.broken or verdict.missing:
            result = f"BROKEN {chain} {verdict.broken}" if verdict.broken else f"MISSING {chain} {verdict.missing}"
            broken = True
        print(f"{result} ({verdict.anchors} heads in the blob store)")
    return _EXIT_BROKEN if broken else 0


async def _chains(functions: Functions, account: str | None) -> list[str]:
    """The chain of one account, by its name or id, or all chains."""
    if account is None:
        return await functions.audit_reader.chains()
    if not account:
        raise StoreError("--account is empty; pass an account's name or id")
    known = await functions.sign_in.known(account)
    return [account if known is None else known.id]
