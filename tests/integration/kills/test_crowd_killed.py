"""Every action ends although concurrent processes are killed with SIGKILL."""

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
from tests.integration.kills.scenes import Scene, action_request, check_scenes, paired, person, report

CROWD = 8
PEOPLE = ("anna", "bert")
Two = list[Identity]


async def run_random_operations(functions: Functions, scenes: list[Scene], seed: int) -> None:
    """Execute random operations until this process is killed."""
    rng = random.Random(seed)  # noqa: S311 (seeded)
    people = [await person(functions, name) for name in PEOPLE]
    while True:
        operation = rng.choice((start_action, start_action, cancel_some, report_some, control, pass_time, hand_over))
        with contextlib.suppress(Problem):
            await operation(functions, rng, rng.sample(people, 2), rng.choice(scenes))


async def start_action(functions: Functions, rng: random.Random, people: Two, scene: Scene) -> None:
    key = rng.choice(("", "", f"key {rng.randrange(50)}"))
    policy = rng.choice(("reject", "queue"))
    await functions.start_action.start(people[0], scene.device, action_request(policy=policy), idempotency_key=key)


async def cancel_some(functions: Functions, rng: random.Random, people: Two, scene: Scene) -> None:
    for action in (await functions.actions.list(people[0], scene.device, cursor=None, limit=rng.randrange(1, 4)))[0]:
        await functions.actions.cancel(people[0], action.id)


async def report_some(functions: Functions, rng: random.Random, people: Two, scene: Scene) -> None:
    for action in (await functions.actions.list(people[0], scene.device, cursor=None, limit=4))[0]:
        await report(functions, action.id, rng.choice(list(AckStatus)))


async def control(functions: Functions, rng: random.Random, people: Two, scene: Scene) -> None:
    lease, *_ = await functions.leases.acquire(people[0], scene.device, epoch=None, lease_ms=3_000, wait_ms=0)
    policy = rng.choice(("reject", "queue"))
    await functions.start_action.start(people[0], scene.device, action_request(epoch=lease.epoch, policy=policy))
    await functions.leases.release(people[0], scene.device, epoch=lease.epoch)


async def pass_time(functions: Functions, rng: random.Random, people: Two, scene: Scene) -> None:
    cast("SetClock", functions.clock).advance(rng.uniform(0, 3))
    await functions.scheduler.run_due_jobs()
    if not rng.randrange(4):
        await functions.stop.stop(people[0], scene.device, "")


async def hand_over(functions: Functions, rng: random.Random, people: Two, scene: Scene) -> None:
    if rng.randrange(4):
        return
    with contextlib.suppress(Problem):
        await functions.unpair.unpair(people[0], scene.agent)
    _, code = await show_code(functions, public=scene.public)
    if code:
        await functions.claim.claim(people[1], code, None)


def check_that_all_actions_end(place: Place, *, kills: int, seed: int, steps: int, devices: int = 3) -> None:
    rng = random.Random(seed)  # noqa: S311 (seeded)

    async def prepare(functions: Functions) -> list[Scene]:
        operator = await person(functions, PEOPLE[0])
        await person(functions, PEOPLE[1])
        return [await paired(functions, operator) for _ in range(devices)]

    scenes = run_here(place, prepare)
    crowd: list[Any] = []
    for number in range(kills):
        place = place.later(rng.uniform(0, 2))
        crowd.append(begin(place, run_random_operations, scenes, seed + number, kill_at=rng.randrange(steps)))
        if len(crowd) >= CROWD:
            assert killed(crowd.pop(rng.randrange(CROWD)))
    for process in crowd:
        assert killed(process)
    run_here(place.later(5), lambda functions: check_scenes(functions, place, scenes))


@pytest.mark.parametrize("place", ["local"], indirect=True)
def test_actions_end_although_concurrent_processes_are_killed(place: Place) -> None:
    check_that_all_actions_end(place, kills=16, seed=1, steps=80)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize(("place", "kills"), [("local", 600), ("azure", 60), ("aws", 60)], indirect=["place"])
def test_actions_end_although_many_concurrent_processes_are_killed(place: Place, kills: int) -> None:
    check_that_all_actions_end(place, kills=kills, seed=secrets.randbits(32), steps=200)
