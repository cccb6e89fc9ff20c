from collections.abc import Iterator

import pytest

from tests.contract.conftest import Brokers
from tests.harness.network.brokers import BROKERS, TRANSPORTS, BrokerKind, RunningBroker, Transport


@pytest.fixture(params=BROKERS)
def kind(request: pytest.FixtureRequest) -> BrokerKind:
    """Every test that takes ``kind`` or ``broker`` runs against each broker."""
    kind: BrokerKind = request.param
    return kind


@pytest.fixture
def running(kind: BrokerKind, brokers: Brokers) -> RunningBroker:
    return brokers(kind)


@pytest.fixture
def broker(running: RunningBroker) -> Iterator[RunningBroker]:
    """It must survive every test without errors."""
    yield running
    assert running.process.poll() is None, running.stderr()
    for word in ("Traceback", "internal error"):
        assert word not in running.stderr()


@pytest.fixture(params=TRANSPORTS)
def transport(request: pytest.FixtureRequest) -> Transport:
    transport: Transport = request.param
    return transport
