"""Several processes that are killed with SIGKILL at once: every action still ends."""

import contextlib
import random
import secrets
from typing import Any, cast

import pytest

from device_agent.protocol import AckStatus
from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from tests.harness.processes import Place, SetClock, begin, killed, run_here, show_code
from tests.integration.kills.scenes import Scene, asked, look, paired, person, report

CROWD = 8
PEOPLE = ("anna", "bert")
Two = list[Identity]


async def anything(functions: Functions, scenes: list[Scene], seed: int) -> None:
    """Do one thing after the other, until this process is killed."""
    chance = random.Random(seed)  # noqa: S311 (chance with a seed)
    who = [await person(functions, name) for name in PEOPLE]
    while True:
        does = chance.choice(
            (start_something, start_something, cancel_some, report_some, control, pass_time, hand_over)
        )
        with contextlib.suppress(Problem):
            await does(functions, chance, chance.sample(who, 2), chance.choice(scenes))


async def start_something(functions: Functions, chance: random.Random, who: Two, scene: Scene) -> None:
    key = chance.choice(("", "", f"key {chance.randrange(50)}"))
    policy = chance.choice(("reject", "queue"))
    await functions.start_action.start(who[0], scene.device, asked(policy=policy), idempotency_key=key)


async def cancel_some(functions: Functions, chance: random.Random, who: Two, scene: Scene) -> None:
    for action in (await functions.actions.list(who[0], scene.device, cursor=None, limit=chance.randrange(1, 4)))[0]:
        await functions.actions.cancel(who[0], action.id)


async def report_some(functions: Functions, chance: random.Random, who: Two, scene: Scene) -> None:
    for action in (await functions.actions.list(who[0], scene.device, cursor=None, limit=4))[0]:
        await report(functions, action.id, chance.choice(list(AckStatus)))


async def control(functions: Functions, chance: random.Random, who: Two, scene: Scene) -> None:
    lease, _ = await functions.leases.acquire(who[0], scene.device, epoch=None, lease_ms=3_000, wait_ms=0)
    policy = chance.choice(("reject", "queue"))
    await functions.start_action.start(who[0], scene.device, asked(epoch=lease.epoch, policy=policy))
    await functions.leases.release(who[0], scene.device, epoch=lease.epoch)


async def pass_time(functions: Functions, chance: random.Random, who: Two, scene: Scene) -> None:
    cast("SetClock", functions.clock).advance(chance.uniform(0, 3))
    await functions.scheduler.run_due_jobs()
    if not chance.randrange(4):
        await functions.stop.stop(who[0], scene.device, "")


async def hand_over(functions: Functions, chance: random.Random, who: Two, scene: Scene) -> None:
    if chance.randrange(4):
        return
    with contextlib.suppress(Problem):
        await functions.unpair.unpair(who[0], scene.agent)
    _, code = await show_code(functions, public=scene.public)
    if code:
        await functions.claim.claim(who[1], code, None)


def see_that_all_of_it_ends(place: Place, *, kills: int, seed: int, steps: int, devices: int = 3) -> None:
    chance = random.Random(seed)  # noqa: S311 (chance with a seed)

    async def prepare(functions: Functions) -> list[Scene]:
        who = await person(functions, PEOPLE[0])
        await person(functions, PEOPLE[1])
        return [await paired(functions, who) for _ in range(devices)]

    scenes = run_here(place, prepare)
    crowd: list[Any] = []
    for number in range(kills):
        place = place.later(chance.uniform(0, 2))
        crowd.append(begin(place, anything, scenes, seed + number, dies_at=chance.randrange(steps)))
        if len(crowd) >= CROWD:
            assert killed(crowd.pop(chance.randrange(CROWD)))
    for process in crowd:
        assert killed(process)
    run_here(place.later(5), lambda functions: look(functions, place, scenes))


@pytest.mark.parametrize("place", ["local"], indirect=True)
def test_of_eight_at_once_any_may_be_killed_anywhere(place: Place) -> None:
    see_that_all_of_it_ends(place, kills=16, seed=1, steps=80)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize(("place", "kills"), [("local", 600), ("azure", 60), ("aws", 60)], indirect=["place"])
def test_of_eight_at_once_any_may_be_killed_anywhere_very_often(place: Place, kills: int) -> None:
    see_that_all_of_it_ends(place, kills=kills, seed=secrets.randbits(32), steps=200)
