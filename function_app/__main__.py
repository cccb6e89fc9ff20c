"""``telescope-server COMMAND``, or ``python -m function_app COMMAND``: the server and its administration."""

import argparse
import logging
import os
import sys
from collections.abc import Sequence

from device_agent.protocol.security import log_output, private_folder
from function_app.entrypoints.cli import accounts, audit, backup, keys, server
from function_app.entrypoints.hosts.port_taken import PortTaken
from function_app.ports.model_compiler import CompilerMissingError
from function_app.ports.tables import StoreError
from function_app.settings import SettingsError

_EXIT_FAILED = 1
_EXIT_PORT_TAKEN = 3
_EXIT_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    parser = argparse.ArgumentParser(prog="telescope-server", description="The Telescope server.")
    log_output.add_arguments(parser, os.environ)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (server, keys, accounts, audit, backup):
        module.add_commands(commands)
    os.umask(private_folder.UMASK)
    options = parser.parse_args(arguments)
    for sdk in ("azure", "botocore"):  # they log every request
        logging.getLogger(sdk).setLevel(logging.WARNING)
    try:
        log_output.configure(options)
        return int(options.run(options))
    except PortTaken as error:
        print(f"telescope-server: {error}", file=sys.stderr)
        return _EXIT_PORT_TAKEN
    except (StoreError, CompilerMissingError, SettingsError, OSError) as error:
        print(f"telescope-server: {error}", file=sys.stderr)
        return _EXIT_FAILED
    except KeyboardInterrupt:
        return _EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
