"""Signing keys in files and, for the unit tests of the services, in memory."""

from pathlib import Path

import pytest

from function_app.adapters.local.signing_keys import FileKeys
from function_app.ports.signing_keys import SigningKeys
from tests.contract.keys.suite import Again, KeysSuite, Time
from tests.fakes.signing_keys import MemorySigningKeys


class TestFileKeys(KeysSuite):
    @pytest.fixture
    def again(self, tmp_path: Path, time: Time) -> Again:
        return lambda: FileKeys(tmp_path / "keys", now_ms=time.now_ms)

    @pytest.fixture
    def keys(self, again: Again) -> SigningKeys:
        return again()


class TestMemorySigningKeys(KeysSuite):
    @pytest.fixture
    def keys(self, time: Time) -> SigningKeys:
        return MemorySigningKeys(now_ms=time.now_ms)

    @pytest.fixture
    def again(self, keys: SigningKeys) -> Again:
        return lambda: keys
