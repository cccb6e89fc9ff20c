"""``python -m function_app audit verify|head``: whether the chains of who did what are whole, and where they end."""

import argparse
from typing import Any

from function_app.bootstrap import Functions
from function_app.domain.audit.hash_chain import CLOUD, Head, parse_head
from function_app.ports.tables import StoreError

_EXIT_BROKEN = 1
_EXIT_WRONG = 2


def add_command(commands: Any) -> None:
    """Add ``audit`` to the commands."""
    audit: argparse.ArgumentParser = commands.add_parser("audit", help="check the chains of who did what")
    verbs = audit.add_subparsers(required=True, metavar="VERB", dest="verb")
    about = {
        "verify": "see whether every record is as it was written; the first that is not is named",
        "head": "print where chains end, to be kept elsewhere and given to verify as --expect",
    }
    for verb, text in about.items():
        parser = verbs.add_parser(verb, help=text)
        parser.add_argument("--account", help=f"name or id of one account, or '{CLOUD}' (default: all)")
        if verb == "verify":
            parser.add_argument(
                "--expect",
                action="append",
                default=[],
                metavar="SEQ:HASH",
                help="a head that was noted elsewhere, of --account; may be given again",
            )


async def run(functions: Functions, options: argparse.Namespace) -> int:
    """Do it; returns the exit code: 0 whole, 1 broken, 2 the command is wrong."""
    try:
        return await _run(functions, options)
    finally:
        await functions.close()


async def _run(functions: Functions, options: argparse.Namespace) -> int:
    trail = functions.audit_reader
    expected = [parse_head(text) for text in getattr(options, "expect", [])]
    if None in expected:
        print("--expect is a number, a colon and 64 hexadecimal digits, as `audit head` prints it")  # noqa: T201
        return _EXIT_WRONG
    if expected and options.account is None:
        print("--expect needs --account: say whose chain it is of")  # noqa: T201
        return _EXIT_WRONG
    chains = await trail.chains() if options.account is None else [await _chain(functions, options.account)]
    if options.verb == "head":
        for chain in chains:
            print(f"{chain} {await trail.head(chain) or 'has no records'}")  # noqa: T201
        return 0
    broken = False
    heads = tuple(head for head in expected if isinstance(head, Head))
    for chain in chains:
        verdict = await trail.verify(chain, expected=heads)
        said = f"BROKEN {chain} {verdict.broken}" if verdict.broken else f"OK {chain} {verdict.head}"
        print(f"{said} ({verdict.anchors} heads noted in the blob store)")  # noqa: T201
        broken = broken or bool(verdict.broken)
    return _EXIT_BROKEN if broken else 0


async def _chain(functions: Functions, account: str) -> str:
    """The chain of an account that is named by its name or its id."""
    if not account:
        raise StoreError("--account is empty; give an account's name or id")
    known = await functions.sign_in.known(account)
    return account if known is None else known.id
