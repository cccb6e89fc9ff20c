"""What the keys in every cloud's vault promise besides ``KeysSuite``."""

from collections.abc import Callable

import pytest

from function_app.adapters.shared import vault_keys
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import StoreError
from tests.contract.keys.suite import Again, KeysSuite, Time

SECRET = "telescope-keys"
Erase = Callable[[], None]


class VaultSuite(KeysSuite):
    """``erase`` deletes every secret of the vault."""

    @pytest.fixture
    async def keys(self, erase: Erase, again: Again) -> SigningKeys:
        erase()
        keys = again()
        for _ in range(2):
            await keys.prepare()  # type: ignore[attr-defined]
        return keys

    def wait_for_followers(self, time: Time) -> None:
        time.ms += vault_keys.CACHE_MS

    @pytest.fixture(autouse=True)
    def _read_unknown_keys_immediately(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(vault_keys, "MIN_REFRESH_MS", 0)

    async def test_a_missing_secret_is_reported_with_the_command_that_creates_it(
        self, erase: Erase, again: Again
    ) -> None:
        erase()
        with pytest.raises(StoreError, match=r"does not exist.*function_app prepare"):
            await again().current()

    @pytest.mark.usefixtures("keys")
    async def test_keys_stay_in_use_while_the_vault_does_not_respond(
        self, again: Again, erase: Erase, time: Time, caplog: pytest.LogCaptureFixture
    ) -> None:
        other = again()
        before = (await other.current()).private_bytes_raw()
        erase()
        time.ms += vault_keys.CACHE_MS
        assert (await other.current()).private_bytes_raw() == before
        assert "remain in use" in caplog.text
