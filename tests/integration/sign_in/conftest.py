"""Fixtures of the sign-in tests."""

import pytest

from tests.harness.cloud.oidc_provider import SigningKey, new_key


@pytest.fixture(scope="module")
def key() -> SigningKey:
    return new_key()
