"""Fixtures that tests of several folders share."""

import contextlib
import os
from collections.abc import Callable, Iterator

import pytest
from hypothesis import HealthCheck, settings

from tests.harness.stores.emulators import StoreKind, start_emulator

pytest_plugins = ["tests.fixtures.brokers", "tests.fixtures.cloud", "tests.fixtures.sampling"]


# Tests do not depend on the speed of the machine.
settings.register_profile("tests", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("tests")


@pytest.fixture(autouse=True)
def _restore_umask() -> Iterator[None]:
    """Restores the umask, which ``main`` of the agent sets when a test calls it in this process."""
    previous = os.umask(0o022)
    os.umask(previous)
    yield
    os.umask(previous)


Emulators = Callable[[StoreKind], str]


@pytest.fixture(scope="session")
def emulators() -> Iterator[Emulators]:
    """Starts the emulator of a cloud store on first use and returns its address."""
    running: dict[StoreKind, str] = {}
    with contextlib.ExitStack() as stack:

        def start(kind: StoreKind) -> str:
            if kind not in running:
                running[kind] = stack.enter_context(start_emulator(kind))
            return running[kind]

        yield start
