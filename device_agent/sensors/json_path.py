"""Finds values in JSON documents by a path with dots."""

from typing import Annotated, Any

import msgspec
from msgspec import Meta

Path = Annotated[str, Meta(min_length=1, max_length=200)]
"""Keys, and indexes of lists, separated by dots: ``DS18B20.Temperature``, ``Power.0``."""
MISSING = object()
"""Result for a path that does not exist."""
_MAX_LISTED = 300


def decode(payload: bytes) -> Any:
    """The document.

    Raises:
        ValueError: It is not JSON. NaN and infinity are not JSON.
    """
    try:
        return msgspec.json.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError("it is not JSON") from error


def find(document: Any, path: str) -> Any:
    """The value at a path, or ``MISSING``. A key may contain dots: the longest key that exists is used."""
    if not path:
        return document
    if isinstance(document, list):
        index, _, rest = path.partition(".")
        known = index.isascii() and index.isdigit() and len(index) < 5 and int(index) < len(document)  # noqa: PLR2004
        return find(document[int(index)], rest) if known else MISSING
    if not isinstance(document, dict):
        return MISSING
    parts = path.split(".")
    for count in range(len(parts), 0, -1):
        key = ".".join(parts[:count])
        if key in document:
            return find(document[key], ".".join(parts[count:]))
    return MISSING


def listed(document: Any) -> str:
    """The paths of a document, for messages."""
    found: list[str] = []
    _collect(document, "", found)
    text = ", ".join(found)
    return (text[:_MAX_LISTED] + " …" if len(text) > _MAX_LISTED else text) or "nothing"


def _collect(document: Any, prefix: str, found: list[str]) -> None:
    if isinstance(document, dict) and prefix.count(".") < 5:  # noqa: PLR2004 (deeper levels are of no use)
        for key, value in document.items():
            if len(found) > _MAX_LISTED:
                return
            printable = "".join(letter if letter.isprintable() else "?" for letter in str(key)[:40])
            _collect(value, f"{prefix}{printable}.", found)
    else:
        found.append(prefix.rstrip("."))
