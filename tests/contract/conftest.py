"""Fixtures that several suites share."""

import contextlib
from collections.abc import AsyncIterator, Callable, Iterator
from itertools import count
from typing import Any, Protocol, TypeVar

import pytest

from tests.conftest import Emulators
from tests.harness.network.brokers import BrokerKind, RunningBroker, start_broker
from tests.harness.stores.aws import use_credentials

T = TypeVar("T")
Brokers = Callable[[BrokerKind], RunningBroker]
_numbers = count()


class Closing(Protocol):
    """Returns an adapter, and closes it after the test."""

    def __call__(self, adapter: T) -> T: ...


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
async def closing() -> AsyncIterator[Closing]:
    async with contextlib.AsyncExitStack() as stack:

        def register(adapter: Any) -> Any:
            stack.push_async_callback(adapter.close)
            return adapter

        yield register


@pytest.fixture(scope="session")
def azurite(emulators: Emulators) -> str:
    """Connection string of one Azurite for all tests, which use separate tables and containers."""
    return emulators("azure")


@pytest.fixture(scope="module")
def moto(emulators: Emulators) -> Iterator[str]:
    """Address of one moto for all tests; the environment has the credentials that it accepts."""
    with pytest.MonkeyPatch.context() as environment:
        use_credentials(environment)
        yield emulators("aws")


@pytest.fixture(scope="session")
def brokers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Brokers]:
    """One broker of a kind for all tests, which use separate spaces; started when the first test needs it."""
    running: dict[BrokerKind, RunningBroker] = {}
    with contextlib.ExitStack() as stack:

        def start(kind: BrokerKind) -> RunningBroker:
            if kind not in running:
                running[kind] = stack.enter_context(start_broker(kind, tmp_path_factory.mktemp(kind)))
            return running[kind]

        yield start


@pytest.fixture
def space() -> str:
    """A space, and part of client ids, that no other test uses."""
    return f"space{next(_numbers)}"
