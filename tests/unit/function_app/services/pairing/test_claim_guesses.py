"""Guessed claim codes, and concurrent claims with one code."""

import asyncio
import random

import pytest

from function_app.domain.common.ids import new_claim_code
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.services.storage import records
from tests.harness.cloud.cloud import Cloud
from tests.harness.processes import show_code

LIVE = 20
"""Number of valid codes."""


@pytest.mark.parametrize(
    "guesses", [1_000, pytest.param(100_000, marks=[pytest.mark.long, pytest.mark.timeout(3_600)])]
)
def test_guessed_claim_codes_claim_nothing(cloud: Cloud, guesses: int) -> None:
    """Unlimited accounts with five attempts each: the number of codes (2.56·10¹⁰) protects."""
    random_numbers = random.Random(1)  # noqa: S311 (random_numbers with a seed)
    functions = cloud.functions

    async def work() -> int:
        shown = [await show_code(functions) for _ in range(LIVE)]
        accounts = [(await functions.sign_in.account(f"a{number}")).id for number in range(20)]
        claimed, answers = 0, set[str]()
        for number in range(guesses):
            if number % 100 == 0:
                for account in accounts:
                    row = await functions.tables.get(records.ATTEMPTS, account, "claim")
                    if row is not None:
                        await functions.tables.delete(records.ATTEMPTS, row)
            caller = Identity(accounts[number // 5 % 20], "x", f"s{random_numbers.randrange(9)}")
            try:
                await functions.claim.claim(caller, new_claim_code(), None)
                claimed += 1
            except Problem as problem:
                answers.add(problem.code)
        for agent, _ in shown:
            row = await functions.tables.get(records.AGENTS, agent, "agent")
            assert row is not None
            claimed += row.data["account"] is not None
        assert answers == {"claim-code-unknown"}
        return claimed

    assert cloud.run(work()) == 0


def test_one_of_a_hundred_concurrent_claims_succeeds(cloud: Cloud) -> None:
    functions = cloud.functions

    async def work() -> list[str]:
        agent, code = await show_code(functions)
        accounts = [(await functions.sign_in.account(f"a{number}")).id for number in range(100)]

        async def one(account: str) -> str:
            try:
                await functions.claim.claim(Identity(account, "x", "s"), code, None)
            except Problem as problem:
                return problem.code
            return account

        results = await asyncio.gather(*(one(account) for account in accounts))
        row = await functions.tables.get(records.AGENTS, agent, "agent")
        assert row is not None
        assert [each for each in results if each in accounts] == [row.data["account"]]
        replayed = await one(accounts[0])
        return [each for each in (*results, replayed) if each not in accounts]

    refusals = cloud.run(work())
    assert len(refusals) == 100
    assert set(refusals) <= {"claim-code-unknown", "busy"}
