"""Eight processes with one store send the same request at the same time: exactly one succeeds."""

from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from functools import partial

import pytest

from device_agent.protocol import MoveJoints
from function_app.bootstrap import Functions
from function_app.domain.identity.accounts import Identity
from function_app.services.actions.requests import ActionRequest
from tests.harness.processes import Place, claimed_devices, race, run_here, show_code

RACERS = range(8)
WRONG_TRIES = 4
"""Number of codes for which one account races; five wrong ones would lock it out."""
START = ActionRequest(request=MoveJoints(position_rad={"elbow": 1.0}), timeout_ms=60_000)
LOST = {
    "slot": "device-busy",
    "lease": "lease-held",
    "claim": "claim-code-unknown",
    "link": "unauthorized",
    "key": "done",  # the same request with one idempotency key: all return the same action
}


@dataclass(frozen=True)
class Contested:
    """One contested resource of each kind per round; each process claims for separate accounts."""

    owner: str
    slots: list[str]
    leases: list[str]
    keys: list[str]
    codes: list[str]
    accounts: list[list[str]]
    links: list[str]


async def prepare(functions: Functions, rounds: int) -> Contested:
    owner = await functions.sign_in.account("owner")
    devices = await claimed_devices(functions, Identity(owner.id, "owner", "s"), 3 * rounds)
    accounts = range(-(-rounds // WRONG_TRIES))
    return Contested(
        owner=owner.id,
        slots=devices[:rounds],
        leases=devices[rounds : 2 * rounds],
        keys=devices[2 * rounds :],
        codes=[(await show_code(functions))[1] for _ in range(rounds)],
        accounts=[
            [(await functions.sign_in.account(f"a{racer}-{number}")).id for number in accounts] for racer in RACERS
        ],
        links=[await functions.sign_in.link(owner) for _ in range(rounds)],
    )


def attempts(functions: Functions, contested: Contested, racer: int) -> Iterator[Callable[[], Awaitable[object]]]:
    same = Identity(contested.owner, "owner", "s")
    own = Identity(contested.owner, "owner", f"s{racer}")
    start, acquire = functions.start_action.start, functions.leases.acquire
    yield from (partial(start, same, device, START) for device in contested.slots)
    yield from (partial(acquire, own, device, epoch=None, lease_ms=60_000, wait_ms=0) for device in contested.leases)
    for number, code in enumerate(contested.codes):
        claimant = Identity(contested.accounts[racer][number // WRONG_TRIES], "x", "s")
        yield partial(functions.claim.claim, claimant, code, None)
    yield from (partial(functions.sign_in.redeem, link) for link in contested.links)
    yield from (partial(start, same, device, START, idempotency_key="one key") for device in contested.keys)


async def check_tables(functions: Functions, contested: Contested) -> None:
    """The tables agree with the responses."""
    owner = Identity(contested.owner, "owner", "s")
    for device in (*contested.slots, *contested.keys):
        actions, _ = await functions.actions.list(owner, device, cursor=None, limit=10)
        assert [action.epoch for action in actions] == [1]
    for device in contested.leases:
        lease = await functions.leases.get(owner, device)
        assert lease is not None
        assert lease.epoch == 1


def check_one_winner(place: Place, rounds: int) -> None:
    contested = run_here(place, partial(prepare, rounds=rounds))
    outcomes = race(place, attempts, contested, RACERS)
    for kind, (name, lost) in enumerate(LOST.items()):
        winners = set()
        for number in range(kind * rounds, (kind + 1) * rounds):
            expected = {"done": len(RACERS)} if lost == "done" else {"done": 1, lost: len(RACERS) - 1}
            assert Counter(each[number] for each in outcomes.values()) == expected, f"{name}, round {number}"
            winners |= {racer for racer, each in outcomes.items() if each[number] == "done"}
        assert len(winners) > 1, f"{name}: one process won every round, so no race occurred"
    run_here(place, partial(check_tables, contested=contested))


@pytest.mark.parametrize("place", ["local"], indirect=True)
def test_one_of_eight_processes_wins(place: Place) -> None:
    check_one_winner(place, 60)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize(("place", "rounds"), [("local", 1_000), ("azure", 200), ("aws", 100)], indirect=["place"])
def test_one_of_eight_processes_wins_in_many_rounds(place: Place, rounds: int) -> None:
    """The processes interleave, although moto answers requests one by one (``tests/harness/stores/aws.py``)."""
    check_one_winner(place, rounds)
