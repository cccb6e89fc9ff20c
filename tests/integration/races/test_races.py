"""Eight processes that want the same thing at the same moment, over one store: exactly one gets it."""

import contextlib
import queue
from collections import Counter
from dataclasses import dataclass
from typing import Any

import pytest

from device_agent.protocol import MoveJoints
from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.services.actions.requests import ActionRequest
from tests.harness.processes import PATIENCE_S, PROCESSES, Place, begin, killed, run_here, show_code

RACERS = 8
DEVICES_OF_AGENT = 20
WRONG_TRIES = 4
"""So many codes one account may race for; five wrong ones would lock it out."""
START = ActionRequest(request=MoveJoints(position_rad={"elbow": 1.0}), timeout_ms=60_000)
LOST = {
    "slot": "device-busy",
    "lease": "lease-held",
    "claim": "claim-code-unknown",
    "link": "unauthorized",
    "key": "won",  # the same request once more: every one of them is answered with the one action
}


@dataclass(frozen=True)
class Prizes:
    """What is raced for, one of each in every round; claims are made for accounts of each process's own."""

    owner: str
    slots: list[str]
    leases: list[str]
    keys: list[str]
    codes: list[str]
    accounts: list[list[str]]
    links: list[str]


def prepare(place: Place, rounds: int) -> Prizes:
    async def work(functions: Functions) -> Prizes:
        owner = await functions.sign_in.account("owner")
        who = Identity(owner.id, "owner", "s")
        devices: list[str] = []
        while len(devices) < 3 * rounds:
            names = [f"d{number}" for number in range(DEVICES_OF_AGENT)]
            agent, code = await show_code(functions, names)
            await functions.claim.claim(who, code, None)
            devices += [f"{agent}-{name}" for name in names]
        return Prizes(
            owner=owner.id,
            slots=devices[:rounds],
            leases=devices[rounds : 2 * rounds],
            keys=devices[2 * rounds : 3 * rounds],
            codes=[(await show_code(functions))[1] for _ in range(rounds)],
            accounts=[
                [
                    (await functions.sign_in.account(f"a{racer}-{number}")).id
                    for number in range(-(-rounds // WRONG_TRIES))
                ]
                for racer in range(RACERS)
            ],
            links=[await functions.sign_in.link(owner) for _ in range(rounds)],
        )

    return run_here(place, work)


async def race(functions: Functions, prizes: Prizes, racer: int, barrier: Any, results: Any) -> None:
    """One process: tries for each prize as soon as all others are ready to."""
    same = Identity(prizes.owner, "owner", "s")
    own = Identity(prizes.owner, "owner", f"s{racer}")
    tries: dict[str, Any] = {
        "slot": lambda n: functions.start_action.start(same, prizes.slots[n], START),
        "lease": lambda n: functions.leases.acquire(own, prizes.leases[n], epoch=None, lease_ms=60_000, wait_ms=0),
        "claim": lambda n: functions.claim.claim(
            Identity(prizes.accounts[racer][n // WRONG_TRIES], "x", "s"), prizes.codes[n], None
        ),
        "link": lambda n: functions.sign_in.redeem(prizes.links[n]),
        "key": lambda n: functions.start_action.start(same, prizes.keys[n], START, idempotency_key="one key"),
    }
    found: dict[str, list[str]] = {}
    for what, attempt in tries.items():
        found[what] = []
        for round_ in range(len(prizes.slots)):
            barrier.wait(PATIENCE_S)
            try:
                await attempt(round_)
                found[what].append("won")
            except Problem as problem:
                found[what].append(problem.code)
    results.put(found)


async def look(functions: Functions, prizes: Prizes) -> None:
    """The tables say the same as the answers."""
    who = Identity(prizes.owner, "owner", "s")
    for device in (*prizes.slots, *prizes.keys):
        actions, _ = await functions.actions.list(who, device, cursor=None, limit=10)
        assert [action.epoch for action in actions] == [1]
    for device in prizes.leases:
        lease = await functions.leases.get(who, device)
        assert lease is not None
        assert lease.epoch == 1


def see_exactly_one_winner(place: Place, rounds: int) -> None:
    prizes = prepare(place, rounds)
    barrier, results = PROCESSES.Barrier(RACERS), PROCESSES.Queue()
    racing = [begin(place, race, prizes, racer, barrier, results) for racer in range(RACERS)]
    found: list[dict[str, list[str]]] = []
    while len(found) < RACERS:
        with contextlib.suppress(queue.Empty):
            found.append(results.get(timeout=1))
        assert not any(process.exitcode for process in racing), "one of them failed: its traceback is above"
    for process in racing:
        assert not killed(process)
    for what, lost in LOST.items():
        for round_ in range(rounds):
            got = Counter(each[what][round_] for each in found)
            expected = {"won": RACERS} if lost == "won" else {"won": 1, lost: RACERS - 1}
            assert got == expected, f"{what}, round {round_}"
        winners = {number for number, each in enumerate(found) if "won" in each[what]}
        assert len(winners) > 1, f"{what}: one process won every round, so no race occurred"
    run_here(place, lambda functions: look(functions, prizes))


@pytest.mark.parametrize(("place", "rounds"), [("local", 250), ("azure", 6), ("aws", 5)], indirect=["place"])
def test_of_eight_processes_exactly_one_gets_it(place: Place, rounds: int) -> None:
    """The processes interleave, although moto answers requests one by one (``tests/harness/stores/aws.py``)."""
    see_exactly_one_winner(place, rounds)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize(("place", "rounds"), [("local", 1_000), ("azure", 200), ("aws", 100)], indirect=["place"])
def test_of_eight_processes_exactly_one_gets_it_again_and_again(place: Place, rounds: int) -> None:
    see_exactly_one_winner(place, rounds)
