"""Addresses and requests of the movement tests."""

from collections.abc import Iterator
from typing import Any

from tests.harness.cloud.cloud import Person
from tests.harness.cloud.memory import Memory

UR5 = "/robot-types/ur5"
MINE = f"{UR5}/movements/mine"
WAVE = f"{UR5}/movements/wave"
SOURCE = '"""Wave twice.\n\nMore."""\nrobot.home()\n'


def paged(person: Person, path: str, **query: Any) -> Iterator[list[dict[str, Any]]]:
    cursor = None
    while True:
        body = person.get(path, params={**query, **({"cursor": cursor} if cursor else {})}).json()
        yield body["items"]
        cursor = body["cursor"]
        if cursor is None:
            return


def scripts(memory: Memory) -> list[str]:
    """Every script in the blob store."""
    return sorted(content.decode() for content in memory.blobs.contents.values())
