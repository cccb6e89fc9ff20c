import pytest

from tests.contract.keys.suite import Time


@pytest.fixture
def time() -> Time:
    return Time()
