"""The version of this release, and the formats of the state on disk that it reads."""

import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import msgspec

VERSION = "0.1.0"
JOURNAL_FORMAT, OUTBOX_FORMAT, PAIRING_FORMAT = 1, 1, 1
"""Newest format of each file that this release reads.

A format grows only with a change that older releases cannot read. First a release reads the new format, and only a
later one writes it (``WRITTEN``), so that the release before can always be used again.
"""
READ: Mapping[str, int] = {"journal.db": JOURNAL_FORMAT, "outbox.db": OUTBOX_FORMAT, "pairing.json": PAIRING_FORMAT}
WRITTEN: Mapping[str, int] = {"journal.db": 1, "outbox.db": 1, "pairing.json": 1}
"""Formats that this release writes."""


class _PairingFormat(msgspec.Struct):
    format: int = 1


def pairing_format(content: bytes) -> int:
    """Format of a ``pairing.json``; 1 if it names none or is damaged."""
    try:
        return msgspec.json.decode(content, type=_PairingFormat).format
    except msgspec.DecodeError:
        return 1


def present_formats(home: Path) -> dict[str, int]:
    """Formats of the files in the agent's folder. Files that are missing or damaged are left out."""
    formats = {}
    for name in ("journal.db", "outbox.db"):
        if (home / name).is_file():
            try:
                uri = f"{(home / name).resolve().as_uri()}?mode=ro"
                with closing(sqlite3.connect(uri, uri=True, timeout=2)) as database:
                    formats[name] = int(database.execute("PRAGMA user_version").fetchone()[0])
            except sqlite3.Error:
                continue
    if (home / "pairing.json").is_file():
        formats["pairing.json"] = pairing_format((home / "pairing.json").read_bytes())
    return formats


def too_new(needed: Mapping[str, int], read: Mapping[str, int]) -> list[str]:
    """Describes each file whose format ``needed`` is newer than the one that a release can ``read``."""
    return [
        f"{name} (format {needed[name]}; it reads up to {read.get(name, 0)})"
        for name in sorted(needed)
        if needed[name] > read.get(name, 0)
    ]
