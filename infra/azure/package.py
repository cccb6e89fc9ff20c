"""``python -m infra.azure.package FOLDER``: create the deployment package of the Azure function in a folder.

Azure's build installs ``requirements.txt`` during the deployment: zip the content of the folder, or run ``func azure
functionapp publish NAME`` in it.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from infra.function_package import PYTHON, PackageError, copy_project, require_console, require_empty

_HOST_FILES = ("function_app.py", "host.json", "requirements.txt")


def main(arguments: Sequence[str] | None = None) -> int:
    """Create the folder; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m infra.azure.package",
        description=f"Package the functions for Azure Functions with Python {PYTHON['azure']}.",
    )
    parser.add_argument("folder", type=Path, help="target folder; must be empty or missing")
    options = parser.parse_args(arguments)
    try:
        require_empty(options.folder)
        require_console()
        copy_project(options.folder, *_HOST_FILES)
    except PackageError as error:
        sys.stderr.write(f"telescope: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
