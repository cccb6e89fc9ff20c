"""``python -m infra.aws FOLDER``: create the deployment package of the Lambda function in a folder.

botocore contains descriptions of over four hundred services (23 MB); only those of used services are included.
Unknown options are passed to pip: on a machine of another platform, ``--platform manylinux2014_x86_64
--only-binary=:all: --python-version 3.13``.
"""

import argparse
import compileall
import py_compile
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("function_app", "device_agent/__init__.py", "device_agent/protocol", "robots", "web/dist")
"""Included parts of the project. The console (``web/dist``) is included if built."""
SERVICES = frozenset({"dynamodb", "iot", "iot-data", "s3", "secretsmanager", "sts"})
"""AWS services that the functions call; sts is for assuming roles."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Create the folder; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m infra.aws", description="Package the functions for AWS Lambda.")
    parser.add_argument("folder", type=Path, help="target folder; must be empty or missing")
    parser.add_argument(
        "--compile", action="store_true", help="include byte code for this Python version; halves Lambda's start time"
    )
    options, for_pip = parser.parse_known_args(arguments)
    if options.folder.exists() and any(options.folder.iterdir()):
        print(f"telescope: {options.folder} is not empty; choose a new folder", file=sys.stderr)
        return 1
    try:
        package(options.folder, for_pip)
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
    for part in PARTS:
        source, target = ROOT / part, folder / part
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
        elif source.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)


if __name__ == "__main__":
    sys.exit(main())
