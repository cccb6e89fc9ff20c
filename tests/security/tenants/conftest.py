from collections.abc import Iterator

import pytest

from tests.harness.cloud.memory import Memory
from tests.security.tenants.world import World, make


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    """Both tenants, in memory."""
    memory = Memory()
    world = make(memory)
    with world.cloud:
        yield world
    memory.loop.end()
