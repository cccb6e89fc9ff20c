"""``python -m device_agent COMMAND``: the agent's command line."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from device_agent.cli import cameras, devices, doctor, enroll, export, load_test, models, new_driver, run, trials
from device_agent.cli.releases import commands as releases
from device_agent.config.errors import ConfigError
from device_agent.config.release import VERSION
from device_agent.load_generator.options import LoadTestError
from device_agent.ports.driver import DriverError
from device_agent.ports.geometry import GeometryError
from device_agent.ports.transport import TransportError
from device_agent.protocol.security import log_output, private_folder
from device_agent.runtime.storage.journal import JournalError
from device_agent.transports.http.client import CloudError

_ERRORS = (
    ConfigError, JournalError, DriverError, GeometryError, TransportError, CloudError, LoadTestError,
    export.ExportError, OSError,
)  # fmt: skip
"""Errors that are shown in one line."""
_COMMANDS = (enroll, run, doctor, devices, cameras, releases, models, new_driver, load_test, export, trials)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        The exit code.
    """
    os.umask(private_folder.UMASK)
    options = _parser().parse_args(arguments)
    try:
        log_output.configure(options)
        code: int = options.command(options)
    except _ERRORS as error:
        print(f"telescope agent: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m device_agent", description="The Telescope agent of a robot.")
    parser.add_argument("--version", action="version", version=f"telescope-agent {VERSION}")
    log_output.add_arguments(parser, os.environ)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    home = Path(os.environ.get("TELESCOPE_AGENT_HOME", Path.home() / ".telescope-agent"))
    for module in _COMMANDS:
        module.add_commands(commands, home)
    return parser


if __name__ == "__main__":
    sys.exit(main())
