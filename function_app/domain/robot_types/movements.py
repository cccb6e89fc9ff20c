"""Movements as stored in the tables."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Movement:
    """One version of a movement; the row of the name holds the newest.

    Attributes:
        since: First version since the last deletion. Version numbers are never reused, so the row of a ``deleted``
            movement remains.
        author: Account that saved it, or ``SHIPPED`` of the wire contract.
        key: Id of the key that signed robot type, name, version and hash.
        parameters_schema: Schema of the parameters; ``None``: any parameters.
    """

    name: str
    description: str
    version: int
    sha256: str
    updated_ms: int
    built_in: bool = False
    deleted: bool = False
    since: int = 1
    author: str = ""
    key: str = ""
    signature: str = ""
    parameters_schema: dict[str, Any] | None = None
