"""``python -m infra.aws FOLDER``: create the deployment package of the Lambda function in a folder.

botocore contains descriptions of over four hundred services (23 MB); only those of used services are included.
Unknown options are passed to pip: with another Python than 3.13 or on another platform, ``--platform
manylinux2014_x86_64 --only-binary=:all: --python-version 3.13``.
"""

import argparse
import compileall
import py_compile
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from infra.function_package import PYTHON, ROOT, PackageError, copy_project, require_console, require_empty

SERVICES = frozenset({"dynamodb", "iot", "iot-data", "s3", "secretsmanager", "sts"})
"""AWS services that the functions call; sts is for assuming roles."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Create the folder; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m infra.aws", description=f"Package the functions for AWS Lambda with Python {PYTHON['aws']}."
    )
    parser.add_argument("folder", type=Path, help="target folder; must be empty or missing")
    parser.add_argument(
        "--compile", action="store_true", help="include byte code for this Python version; halves Lambda's start time"
    )
    options, for_pip = parser.parse_known_args(arguments)
    try:
        require_empty(options.folder)
        require_console()
        package(options.folder, for_pip)
    except PackageError as error:
        print(f"telescope: {error}", file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as error:
        print(f"telescope: pip could not install the packages (exit code {error.returncode})", file=sys.stderr)
        return 1
    if options.compile:
        # Unchecked hash-based pyc files: unpacking the archive changes the modification times.
        unchecked = py_compile.PycInvalidationMode.UNCHECKED_HASH
        compileall.compile_dir(options.folder, quiet=2, workers=0, invalidation_mode=unchecked)
    return 0


def package(folder: Path, for_pip: Sequence[str] = ()) -> None:
    """Install the libraries without unused parts, and copy the project's code.

    Raises:
        subprocess.CalledProcessError: pip failed and has printed the reason.
    """
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"]
    requirements = ROOT / "requirements" / "aws.txt"
    subprocess.run([*pip, "--target", str(folder), "-r", str(requirements), *for_pip], check=True)  # noqa: S603 (pip)
    for service in (folder / "botocore" / "data").iterdir():
        if service.is_dir() and service.name not in SERVICES:
            shutil.rmtree(service)
    copy_project(folder)


if __name__ == "__main__":
    sys.exit(main())
