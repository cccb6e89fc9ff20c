from collections.abc import Iterator
from itertools import count

import pytest

from tests.harness.network.brokers import BROKERS, TRANSPORTS, BrokerKind, RunningBroker, Transport, start_broker

_spaces = count()


@pytest.fixture(params=BROKERS, scope="session")
def kind(request: pytest.FixtureRequest) -> BrokerKind:
    """Every test that takes ``kind`` or ``broker`` runs against each broker."""
    found: BrokerKind = request.param
    return found


@pytest.fixture(scope="session")
def running(kind: BrokerKind, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningBroker]:
    with start_broker(kind, tmp_path_factory.mktemp(kind)) as broker:
        yield broker


@pytest.fixture
def broker(running: RunningBroker) -> Iterator[RunningBroker]:
    """One broker for all tests, which use separate spaces. It must survive every test without errors."""
    yield running
    assert running.process.poll() is None, running.stderr()
    for word in ("Traceback", "internal error"):
        assert word not in running.stderr()


@pytest.fixture
def space() -> str:
    """A space, and part of client ids, that no other test uses."""
    return f"space{next(_spaces)}"


@pytest.fixture(params=TRANSPORTS)
def transport(request: pytest.FixtureRequest) -> Transport:
    found: Transport = request.param
    return found
