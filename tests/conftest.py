"""What tests of several folders share."""

import contextlib
from collections.abc import Callable, Iterator

import pytest

from tests.harness.stores.emulators import StoreKind, start_emulator

pytest_plugins = ["tests.fixtures.cloud"]

Emulators = Callable[[StoreKind], str]


@pytest.fixture(scope="session")
def emulators() -> Iterator[Emulators]:
    """The address of what stands in for a cloud's store, started when the first test needs it."""
    running: dict[StoreKind, str] = {}
    with contextlib.ExitStack() as stack:

        def start(kind: StoreKind) -> str:
            if kind not in running:
                running[kind] = stack.enter_context(start_emulator(kind))
            return running[kind]

        yield start
