"""Concurrent processes end a request for control, each by another operation: one succeeds."""

import json
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from functools import partial
from unittest import mock

import pytest

from function_app.bootstrap import Functions
from function_app.domain.identity.accounts import Identity
from function_app.services.actions import stop
from function_app.services.storage import records
from tests.harness.processes import Place, claimed_devices, commands_sent, race, run_here

RACERS = ("accept", "refuse", "withdraw", "release", "take over", "reset")
RAISES = {"accept", "take over", "reset"}
"""Operations that increase the epoch."""
ENDS = {
    "control-handed-over": "accepted",
    "control-request-denied": "rejected",
    "control-request-withdrawn": "withdrawn",
}


@dataclass(frozen=True)
class Scene:
    """Devices of which another session requests control."""

    account: str
    devices: list[str]
    requests: list[str]

    def identity(self, session: str) -> Identity:
        return Identity(self.account, session, session)


async def prepare(functions: Functions, rounds: int) -> Scene:
    account = (await functions.sign_in.account("owner")).id
    holder, requester = Identity(account, "holder", "holder"), Identity(account, "requester", "requester")
    devices = await claimed_devices(functions, holder, rounds)
    requests = []
    for device in devices:
        await functions.leases.acquire(holder, device, epoch=None, lease_ms=600_000, wait_ms=0)
        _, request, _, _ = await functions.control_requests.create(
            requester, device, within_ms=60_000, lease_ms=600_000, wait_ms=0
        )
        requests.append(request.id)
    return Scene(account, devices, requests)


def attempts(functions: Functions, scene: Scene, racer: str) -> Iterator[Callable[[], Awaitable[object]]]:
    return (partial(act, functions, racer, scene, number) for number in range(len(scene.devices)))


async def act(functions: Functions, operation: str, scene: Scene, number: int) -> None:
    device, request = scene.devices[number], scene.requests[number]
    holder, requester, third = (scene.identity(name) for name in ("holder", "requester", "third"))
    match operation:
        case "accept":
            await functions.control_requests.accept(holder, device, request, wait_ms=0)
        case "refuse":
            await functions.control_requests.reject(holder, device, request)
        case "withdraw":
            await functions.control_requests.withdraw(requester, device, request)
        case "release":
            await functions.leases.release(holder, device, epoch=1)
        case "take over":
            await functions.leases.acquire(third, device, epoch=None, lease_ms=600_000, wait_ms=0, over="a reason")
        case "reset":
            with mock.patch.object(stop, "CONFIRM_MS", 0):  # no device responds
                await functions.stop.reset(third, device)


async def check_round(functions: Functions, scene: Scene, number: int, results: dict[str, str]) -> str:
    """Check that rows, responses and events agree; returns the outcome of the request."""
    device = scene.devices[number]
    row = await functions.tables.get(records.CONTROL, device, "now:lease")
    assert row is not None
    raised = {operation for operation in RAISES if results[operation] == "done"}
    assert row.data["epoch"] == 1 + len(raised), (results, row.data)
    outcome: str = row.data["request"]["outcome"]
    found = await functions.devices.get(scene.identity("holder"), device)
    events, _ = await functions.events.read(found, cursor=None, limit=100)
    kinds = Counter(event["kind"] for event in events)
    assert [ENDS[kind] for kind in kinds if kind in ENDS] == [outcome] * (outcome in ENDS.values()), (results, kinds)
    assert (results["accept"] == "done") == (outcome == "accepted"), (results, outcome)
    assert (results["refuse"] == "done") == (outcome == "rejected"), (results, outcome)
    assert kinds["control-released"] == (results["release"] == "done")
    assert kinds["control-taken"] + kinds["control-taken-over"] == 1 + (results["take over"] == "done")
    assert max(kinds[kind] for kind in ENDS) <= 1
    return outcome


def commands_by_epoch(place: Place) -> dict[tuple[str, int], Counter[str]]:
    """Kinds of commands by device and epoch."""
    found: dict[tuple[str, int], Counter[str]] = {}
    for payloads in commands_sent(place).values():
        for payload in payloads:
            command = json.loads(payload)["body"]
            key = (f"{command['agent']}-{command['device']}", command["epoch"])
            found.setdefault(key, Counter())[command["request"]["kind"]] += 1
    return found


def check_one_outcome(place: Place, rounds: int) -> None:
    scene = run_here(place, partial(prepare, rounds=rounds))
    outcomes_by_racer = race(place, attempts, scene, RACERS)

    async def check_all_rounds(functions: Functions) -> set[str]:
        return {
            await check_round(functions, scene, n, {operation: outcomes_by_racer[operation][n] for operation in RACERS})
            for n in range(rounds)
        }

    outcomes = run_here(place, check_all_rounds)
    assert len(outcomes) > 1, f"no race occurred: {outcomes}"
    for (device, epoch), kinds in commands_by_epoch(place).items():
        assert kinds["grant_lease"] + kinds["reset_stop"] <= 1, f"epoch {epoch} of {device} was assigned twice"


@pytest.mark.parametrize("place", ["local"], indirect=True)
def test_a_request_for_control_has_one_outcome(place: Place) -> None:
    check_one_outcome(place, 60)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize(("place", "rounds"), [("local", 3_000), ("azure", 200), ("aws", 100)], indirect=["place"])
def test_a_request_for_control_has_one_outcome_in_many_rounds(place: Place, rounds: int) -> None:
    check_one_outcome(place, rounds)
