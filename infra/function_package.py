"""The project's files in the deployment package of a Functions host."""

import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHON = {"azure": "3.13", "aws": "3.13"}
"""Python version of each cloud. The requirements files install on it; configure the function with the same version."""
PARTS = ("function_app", "device_agent/__init__.py", "device_agent/protocol", "robots", "web/dist")


class PackageError(Exception):
    """The package cannot be built; the text says what to do."""


def require_console(root: Path = ROOT) -> None:
    """Check that the console is built.

    Raises:
        PackageError: It is not.
    """
    if not (root / "web" / "dist" / "index.html").is_file():
        raise PackageError("the console is not built; run `make console` first")


def require_empty(folder: Path) -> None:
    """Check that the target is empty or missing.

    Raises:
        PackageError: It is not empty.
    """
    if folder.exists() and any(folder.iterdir()):
        raise PackageError(f"{folder} is not empty; choose a new folder")


def copy_project(folder: Path, *more: str, root: Path = ROOT) -> None:
    """Copy the parts of the project that the functions need, and ``more``."""
    for part in (*PARTS, *more):
        source, target = root / part, folder / part
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
