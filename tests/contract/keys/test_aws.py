"""Signing keys in Amazon's Secrets Manager, as moto plays it."""

from collections.abc import AsyncIterator, Iterator

import pytest

from function_app.adapters.aws.signing_keys import SecretsManagerKeys
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import StoreError
from tests.contract.keys.suite import Again, KeysSuite, Time
from tests.harness.stores.aws import REGION, reset, start_moto, use_credentials

LOOK_MS = 100


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with start_moto() as endpoint, pytest.MonkeyPatch.context() as environment:
        use_credentials(environment)
        yield endpoint


@pytest.fixture
async def again(endpoint: str, time: Time) -> AsyncIterator[Again]:
    opened: list[SecretsManagerKeys] = []

    async def open_() -> SigningKeys:
        opened.append(
            SecretsManagerKeys(
                secret="telescope-keys",
                region=REGION,
                endpoint=endpoint,
                now_ms=time.now_ms,
                look_every_ms=LOOK_MS,
                again_ms=0,
            )
        )
        return opened[-1]

    yield open_
    for each in opened:
        await each.close()


@pytest.fixture
async def keys(endpoint: str, again: Again) -> SigningKeys:
    reset(endpoint)
    keys = await again()
    assert isinstance(keys, SecretsManagerKeys)
    await keys.prepare()
    await keys.prepare()
    return keys


class TestSecretsManagerKeys(KeysSuite):
    def wait_for_followers(self, time: Time) -> None:
        time.ms += LOOK_MS


@pytest.mark.anyio
async def test_without_the_secret_it_says_what_to_do(endpoint: str, again: Again) -> None:
    reset(endpoint)
    with pytest.raises(StoreError, match=r"does not exist.*function_app prepare"):
        await (await again()).current()


@pytest.mark.usefixtures("keys")
@pytest.mark.anyio
async def test_while_the_vault_is_away_the_keys_that_were_read_go_on(
    again: Again, endpoint: str, time: Time, caplog: pytest.LogCaptureFixture
) -> None:
    other = await again()
    before = (await other.current()).private_bytes_raw()
    reset(endpoint)
    time.ms += LOOK_MS
    assert (await other.current()).private_bytes_raw() == before
    assert "stay in force" in caplog.text
