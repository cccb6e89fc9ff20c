"""Signing keys in files."""

from pathlib import Path

import pytest

from function_app.adapters.local.signing_keys import FileKeys
from function_app.ports.signing_keys import SigningKeys
from tests.contract.keys.suite import Again, KeysSuite, Time


@pytest.fixture
def keys(tmp_path: Path, time: Time) -> SigningKeys:
    return FileKeys(tmp_path / "keys", now_ms=time.now_ms)


@pytest.fixture
def again(tmp_path: Path, time: Time) -> Again:
    async def open_() -> SigningKeys:
        return FileKeys(tmp_path / "keys", now_ms=time.now_ms)

    return open_


class TestFileKeys(KeysSuite):
    pass
