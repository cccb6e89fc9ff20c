"""Options that several commands share."""

import argparse
from pathlib import Path
from typing import TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # noqa: SLF001 (argparse has no public name)


def add_home(parser: argparse.ArgumentParser, home: Path) -> None:
    """Add ``--home``, the agent's folder."""
    parser.add_argument("--home", type=Path, default=home, help="the agent's folder (default: %(default)s)")


def add_no_qr(parser: argparse.ArgumentParser) -> None:
    """Add ``--no-qr``."""
    parser.add_argument("--no-qr", action="store_true", help="print the claim code and the link without a QR code")
