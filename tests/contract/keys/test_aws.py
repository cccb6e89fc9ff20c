"""Signing keys in Amazon's Secrets Manager, as moto plays it."""

import pytest

from function_app.adapters.aws.signing_keys import SecretsManagerKeys
from tests.contract.conftest import Closing
from tests.contract.keys.suite import Again, Time
from tests.contract.keys.vault_suite import SECRET, Erase, VaultSuite
from tests.harness.stores.aws import REGION, reset


class TestSecretsManagerKeys(VaultSuite):
    @pytest.fixture
    def erase(self, moto: str) -> Erase:
        return lambda: reset(moto)

    @pytest.fixture
    def again(self, moto: str, time: Time, closing: Closing) -> Again:
        return lambda: closing(SecretsManagerKeys(secret=SECRET, region=REGION, endpoint=moto, now_ms=time.now_ms))
