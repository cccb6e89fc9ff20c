"""Addresses and requests of the movement tests."""

from tests.harness.cloud.memory import Memory

UR5 = "/robot-types/ur5"
MINE = f"{UR5}/movements/mine"
WAVE = f"{UR5}/movements/wave"
SOURCE = '"""Wave twice.\n\nMore."""\nrobot.home()\n'


def scripts(memory: Memory) -> list[str]:
    """Every script in the blob store."""
    return sorted(content.decode() for content in memory.blobs.contents.values())
