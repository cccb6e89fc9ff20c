"""The token cache is bounded: expired checks are removed."""

import asyncio
from pathlib import Path

import pytest

from function_app import bootstrap, settings
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.services.identity.authenticator import API, RECHECK_MS
from tests.fakes.clock import MovingClock


def test_tokens_due_for_a_check_are_not_cached(tmp_path: Path) -> None:
    asyncio.run(_kept(tmp_path))


async def _kept(tmp_path: Path) -> None:
    clock = MovingClock()
    functions = bootstrap.build(settings.read({"TELESCOPE_HOME": str(tmp_path)}), clock=clock)
    identify = functions.authenticator
    who = Identity("account", "ann", "session", until_ms=clock.now_ms() + 3_600_000)
    early = [await identify.issue(who, API, 600) for _ in range(5)]
    for token in early:
        assert (await identify.person(token, API)).account == "account"
    assert len(identify._known) == len(early)
    clock.advance(RECHECK_MS / 1000 - 1)
    await identify.person(early[0], API)
    clock.advance(2)
    late = await identify.issue(who, API, 600)
    await identify.person(late, API)
    assert set(identify._known) == {(API, late)}
    assert (await identify.person(early[1], API)).account == "account", "it counts, remembered or not"
    clock.advance(601)
    with pytest.raises(Problem, match="expired"):
        await identify.person(late, API)
    await functions.close()
