"""Processes that want the same thing at the same moment, over one SQLite file: exactly one gets it."""

import asyncio
import multiprocessing
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import signing
from function_app import bootstrap
from function_app.bootstrap import Functions
from function_app.domain.accounts import Identity
from function_app.domain.devices import DeviceSpec
from function_app.domain.ids import agent_id
from function_app.domain.problems import Problem
from function_app.services.enroll import Enrollment
from function_app.services.start_action import AskJoints, Start
from function_app.settings import Settings

ROUNDS = 60
PATIENCE_S = 60.0
_SPAWN = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Prize:
    """What is raced for, one of each in every round; accounts are one for each process."""

    slots: list[str]
    leases: list[str]
    owner: str
    codes: list[str]
    accounts: list[list[str]]
    links: list[str]


class _NoBus:
    """Nobody listens: these races are decided in the tables."""

    def __init__(self, **_: Any) -> None:
        pass

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1) -> None:
        pass

    @asynccontextmanager
    async def acks(self, device_topic: str, command: str) -> AsyncIterator[None]:
        del device_topic, command
        yield None

    async def close(self) -> None:
        pass


def build(home: Path) -> Functions:
    vars(bootstrap)["MqttCommandBus"] = _NoBus
    return bootstrap.build(Settings(home=home))


async def prepare(home: Path, processes: int) -> Prize:
    functions = bootstrap.build(Settings(home=home))
    owner = await functions.sign_in.account("owner")
    who = Identity(owner.id, "owner", "s")
    names = [f"d{number}" for number in range(2 * ROUNDS)]
    agent = (await functions.claim.claim(who, await enroll(functions, names), None)).id
    devices = [f"{agent}-{name}" for name in names]
    prize = Prize(
        slots=devices[:ROUNDS],
        leases=devices[ROUNDS:],
        owner=owner.id,
        codes=[await enroll(functions, ["arm"]) for _ in range(ROUNDS)],
        accounts=[
            [(await functions.sign_in.account(f"a{number}-{process}")).id for number in range(ROUNDS)]
            for process in range(processes)
        ],
        links=[await functions.sign_in.link(owner) for _ in range(ROUNDS)],
    )
    await functions.close()
    return prize


async def enroll(functions: Functions, names: list[str]) -> str:
    key = signing.generate().public_key()
    specs = tuple(DeviceSpec(name, "arm", "ur5", name) for name in names)
    told = Enrollment("lab", signing.public_text(key), "1", specs)
    return (await functions.enroll.enroll(agent_id(signing.key_id(key)), told)).claim_code


def race(home: Path, prize: Prize, number: int, barrier: Any, results: Any) -> None:
    """One process: tries for each prize as soon as all others are ready to."""
    results.put(asyncio.run(_race(build(home), prize, number, barrier)))


async def _race(functions: Functions, prize: Prize, number: int, barrier: Any) -> dict[str, list[str]]:
    same = Identity(prize.owner, "owner", "s")
    own = Identity(prize.owner, "owner", f"s{number}")
    start = Start(asked=AskJoints(position_rad={"elbow": 1.0}), timeout_ms=60_000)
    tries: dict[str, Callable[[int], Awaitable[object]]] = {
        "slot": lambda n: functions.start_action.start(same, prize.slots[n], start),
        "lease": lambda n: functions.leases.take(own, prize.leases[n], epoch=None, lease_ms=60_000, wait_ms=0),
        "claim": lambda n: functions.claim.claim(Identity(prize.accounts[number][n], "x", "s"), prize.codes[n], None),
        "link": lambda n: functions.sign_in.redeem(prize.links[n]),
    }
    found: dict[str, list[str]] = {}
    for what, attempt in tries.items():
        found[what] = []
        for round_ in range(ROUNDS):
            barrier.wait(PATIENCE_S)
            try:
                await attempt(round_)
                found[what].append("won")
            except Problem as problem:
                found[what].append(problem.code)
    await functions.close()
    return found


LOST = {"slot": "device-busy", "lease": "lease-held", "claim": "claim-code-unknown", "link": "unauthorized"}


@pytest.mark.parametrize("processes", [2, 4])
def test_of_many_processes_exactly_one_gets_it(tmp_path: Path, processes: int) -> None:
    prize = asyncio.run(prepare(tmp_path, processes))
    barrier, results = _SPAWN.Barrier(processes), _SPAWN.Queue()
    running = [
        _SPAWN.Process(target=race, args=(tmp_path, prize, number, barrier, results)) for number in range(processes)
    ]
    for process in running:
        process.start()
    found: list[dict[str, list[str]]] = [results.get(timeout=PATIENCE_S) for _ in running]
    for process in running:
        process.join(PATIENCE_S)
        assert process.exitcode == 0
    for what, lost in LOST.items():
        for round_ in range(ROUNDS):
            got = Counter(each[what][round_] for each in found)
            assert got == {"won": 1, lost: processes - 1}, f"{what}, round {round_}"
        winners = {number for number, each in enumerate(found) if "won" in each[what]}
        assert len(winners) > 1, f"{what}: one process won every round, so nobody raced"
    asyncio.run(look(tmp_path, prize))


async def look(home: Path, prize: Prize) -> None:
    """The tables say the same as the answers."""
    functions = bootstrap.build(Settings(home=home))
    who = Identity(prize.owner, "owner", "s")
    for device in prize.slots:
        actions, _ = await functions.actions.list(who, device, cursor=None, limit=10)
        assert [action.epoch for action in actions] == [1]
    for device in prize.leases:
        lease = await functions.leases.get(who, device)
        assert lease is not None
        assert lease.epoch == 1
    await functions.close()
