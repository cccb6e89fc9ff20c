"""``MemorySigningKeys``, which the unit tests of the services use, fulfils the port's contract."""

import pytest

from function_app.ports.signing_keys import SigningKeys
from tests.contract.keys.suite import Again, KeysSuite, Time
from tests.fakes.signing_keys import MemorySigningKeys


@pytest.fixture
def keys(time: Time) -> SigningKeys:
    return MemorySigningKeys(now_ms=time.now_ms)


@pytest.fixture
def again(keys: SigningKeys) -> Again:
    async def open_() -> SigningKeys:
        return keys

    return open_


class TestMemorySigningKeys(KeysSuite):
    pass
