"""``load-test``: simulate many agents without physics in one process."""

import argparse
from pathlib import Path

from device_agent.cli.arguments import Commands
from device_agent.load_generator.options import add_options, parse_options


def add_commands(commands: Commands, _home: Path) -> None:
    """Add ``load-test``."""
    parser = commands.add_parser("load-test", help="test a server with many simulated agents in one process")
    add_options(parser)
    parser.set_defaults(command=_load_test)


def _load_test(options: argparse.Namespace) -> int:
    # Imported here: the load generator uses modules that only Unix has.
    from device_agent.load_generator import run  # noqa: PLC0415

    return run.run(parse_options(options))
