"""What the command bus's tests share."""

from collections.abc import Iterator

import pytest

from tests.harness.network.brokers import BROKERS, BrokerKind, RunningBroker, start_broker


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(params=BROKERS, scope="module")
def broker(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningBroker]:
    kind: BrokerKind = request.param
    with start_broker(kind, tmp_path_factory.mktemp(kind)) as broker:
        yield broker
