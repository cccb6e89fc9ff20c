"""Tokens that are due for a check are not cached; malformed tokens are refused."""

import pytest

from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.services.identity.authenticator import API, RECHECK_MS
from tests.harness.cloud.cloud import Cloud, problem


def test_tokens_due_for_a_check_are_not_cached(cloud: Cloud) -> None:
    authenticator = cloud.functions.authenticator
    caller = Identity("account", "ann", "session", until_ms=cloud.clock.now_ms() + 3_600_000)

    async def check() -> None:
        early = [await authenticator.issue(caller, API, 600) for _ in range(5)]
        for token in early:
            assert (await authenticator.person(token, API)).account == "account"
        assert len(authenticator._cache) == len(early)
        cloud.clock.advance(RECHECK_MS / 1000 - 1)
        await authenticator.person(early[0], API)
        cloud.clock.advance(2)
        late = await authenticator.issue(caller, API, 600)
        await authenticator.person(late, API)
        assert set(authenticator._cache) == {(API, late)}
        assert (await authenticator.person(early[1], API)).account == "account", "valid, cached or not"
        cloud.clock.advance(601)
        with pytest.raises(Problem, match="expired"):
            await authenticator.person(late, API)

    cloud.run(check())


@pytest.mark.parametrize("token", ["x", "x.y.z", "a" * 10_000])
def test_a_malformed_token_is_refused_without_a_library_message(cloud: Cloud, token: str) -> None:
    answer = cloud.request("GET", "/api/v1/accounts/me", headers={"Authorization": f"Bearer {token}"})
    assert problem(answer, 401, "unauthorized")["detail"] == "The access token is not valid. Sign in again."
