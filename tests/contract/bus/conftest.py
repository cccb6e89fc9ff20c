import pytest

from tests.contract.conftest import Brokers
from tests.harness.network.brokers import BROKERS, RunningBroker


@pytest.fixture(params=BROKERS)
def broker(request: pytest.FixtureRequest, brokers: Brokers) -> RunningBroker:
    return brokers(request.param)
