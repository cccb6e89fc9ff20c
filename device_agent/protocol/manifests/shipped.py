"""Location of the robot types and rooms that Telescope ships."""

from pathlib import Path
from typing import Final

_PACKAGE = Path(__file__).resolve().parents[2]
_IN_WHEEL = _PACKAGE / "robots"

ROBOTS: Final = _IN_WHEEL if _IN_WHEEL.is_dir() else _PACKAGE.parent / "robots"
"""Folder of the shipped robot types; ``rooms`` is inside. A wheel contains it inside the package."""
