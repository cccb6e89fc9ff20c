"""Everything that may become of a request for control, done by as many processes in one moment: one thing happens."""

import contextlib
import json
import queue
from collections import Counter
from dataclasses import dataclass
from typing import Any
from unittest import mock

import pytest

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.services.actions import stop
from function_app.services.storage import records
from tests.harness.processes import PATIENCE_S, PROCESSES, Place, begin, commands_sent, killed, run_here, show_code

RACERS = ("accept", "refuse", "withdraw", "release", "take over", "reset")
RAISES = {"accept", "take over", "reset"}
"""What gives the next epoch."""
DEVICES_OF_AGENT = 20
ENDS = {
    "control-handed-over": "accepted",
    "control-request-refused": "rejected",
    "control-request-withdrawn": "withdrawn",
}


@dataclass(frozen=True)
class Scene:
    """Devices whose holder is asked for control."""

    account: str
    devices: list[str]
    requests: list[str]

    def who(self, session: str) -> Identity:
        return Identity(self.account, session, session)


def prepare(place: Place, rounds: int) -> Scene:
    async def work(functions: Functions) -> Scene:
        account = (await functions.sign_in.account("owner")).id
        holder, asker = Identity(account, "holder", "holder"), Identity(account, "asker", "asker")
        devices: list[str] = []
        while len(devices) < rounds:
            names = [f"d{number}" for number in range(DEVICES_OF_AGENT)]
            agent, code = await show_code(functions, names)
            await functions.claim.claim(holder, code, None)
            devices += [f"{agent}-{name}" for name in names]
        requests = []
        for device in devices[:rounds]:
            await functions.leases.acquire(holder, device, epoch=None, lease_ms=600_000, wait_ms=0)
            _, asked, _, _ = await functions.control_requests.create(
                asker, device, within_ms=60_000, lease_ms=600_000, wait_ms=0
            )
            requests.append(asked.id)
        return Scene(account, devices[:rounds], requests)

    return run_here(place, work)


async def act(functions: Functions, what: str, scene: Scene, number: int) -> None:
    device, request = scene.devices[number], scene.requests[number]
    holder, asker, third = (scene.who(name) for name in ("holder", "asker", "third"))
    match what:
        case "accept":
            await functions.control_requests.accept(holder, device, request, wait_ms=0)
        case "refuse":
            await functions.control_requests.reject(holder, device, request)
        case "withdraw":
            await functions.control_requests.withdraw(asker, device, request)
        case "release":
            await functions.leases.release(holder, device, epoch=1)
        case "take over":
            await functions.leases.acquire(third, device, epoch=None, lease_ms=600_000, wait_ms=0, over="why not")
        case "reset":
            with mock.patch.object(stop, "CONFIRM_MS", 0):  # no device confirms here
                await functions.stop.reset(third, device)


async def race(functions: Functions, scene: Scene, what: str, barrier: Any, results: Any) -> None:
    """One process: does its thing to each device as soon as all others are ready to."""
    found = []
    for number in range(len(scene.devices)):
        barrier.wait(PATIENCE_S)
        try:
            await act(functions, what, scene, number)
            found.append("done")
        except Problem as problem:
            found.append(problem.code)
    results.put((what, found))


async def look(functions: Functions, scene: Scene, number: int, did: dict[str, str]) -> str:
    """That rows, answers, events and orders tell of one and the same course; gives what became of the request."""
    device = scene.devices[number]
    row = await functions.tables.get(records.CONTROL, device, "now:lease")
    assert row is not None
    raised = {what for what in RAISES if did[what] == "done"}
    assert row.data["epoch"] == 1 + len(raised), (did, row.data)
    outcome: str = row.data["request"]["outcome"]
    found = await functions.devices.get(scene.who("holder"), device)
    events, _ = await functions.events.read(found, cursor=None, limit=100)
    kinds = Counter(event["kind"] for event in events)
    assert [ENDS[kind] for kind in kinds if kind in ENDS] == [outcome] * (outcome in ENDS.values()), (did, kinds)
    assert (did["accept"] == "done") == (outcome == "accepted"), (did, outcome)
    assert (did["refuse"] == "done") == (outcome == "rejected"), (did, outcome)
    assert kinds["control-released"] == (did["release"] == "done")
    assert kinds["control-taken"] + kinds["control-taken-over"] == 1 + (did["take over"] == "done")
    assert max(kinds[kind] for kind in ENDS) <= 1
    return outcome


def orders(place: Place) -> dict[tuple[str, int], Counter[str]]:
    """Kinds of orders by device and epoch."""
    found: dict[tuple[str, int], Counter[str]] = {}
    for payloads in commands_sent(place).values():
        for payload in payloads:
            command = json.loads(payload)["body"]
            key = (f"{command['agent']}-{command['device']}", command["epoch"])
            found.setdefault(key, Counter())[command["request"]["kind"]] += 1
    return found


@pytest.mark.parametrize(("place", "rounds"), [("local", 120)], indirect=["place"])
def test_of_all_that_may_become_of_a_request_one_thing_does(place: Place, rounds: int) -> None:
    see_one_outcome(place, rounds)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize(("place", "rounds"), [("local", 3_000), ("azure", 200), ("aws", 100)], indirect=["place"])
def test_so_it_is_thousands_of_times_and_over_the_clouds_stores(place: Place, rounds: int) -> None:
    see_one_outcome(place, rounds)


def see_one_outcome(place: Place, rounds: int) -> None:
    scene = prepare(place, rounds)
    barrier, results = PROCESSES.Barrier(len(RACERS)), PROCESSES.Queue()
    racing = [begin(place, race, scene, what, barrier, results) for what in RACERS]
    found: dict[str, list[str]] = {}
    while len(found) < len(RACERS):
        with contextlib.suppress(queue.Empty):
            what, answers = results.get(timeout=1)
            found[what] = answers
        assert not any(process.exitcode for process in racing), "one of them failed: its traceback is above"
    for process in racing:
        assert not killed(process)

    async def whole(functions: Functions) -> Counter[str]:
        return Counter(
            [await look(functions, scene, n, {what: found[what][n] for what in RACERS}) for n in range(rounds)]
        )

    outcomes = run_here(place, whole)
    assert len(outcomes) > 1, f"no race occurred: {outcomes}"
    for (device, epoch), kinds in orders(place).items():
        granted = kinds["grant_lease"] + kinds["reset_stop"]
        assert granted <= 1, f"epoch {epoch} of {device} was given twice"
