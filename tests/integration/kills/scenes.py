"""Initial states, operations and checks of the kill tests."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, cast

import pytest

from device_agent.protocol import Ack, AckStatus, MoveJoints, codec, topics
from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.services.actions.requests import ActionRequest
from function_app.services.maintenance.scheduler import ORPHAN_MS
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS
from tests.harness.processes import Place, SetClock, Work, commands_sent, new_public_key, show_code

TTL_S, TIMEOUT_S, QUEUE_S = 2, 6, 10
MOVE = MoveJoints(position_rad={"elbow": 1.0})
TERMINAL = {"done", "failed", "expired", "cancelled"}


def action_request(**more: Any) -> ActionRequest:
    return ActionRequest(
        request=MOVE, ttl_ms=1000 * TTL_S, timeout_ms=1000 * TIMEOUT_S, queue_ms=1000 * QUEUE_S, **more
    )


@dataclass(frozen=True)
class Scene:
    """A person and a robot with one device."""

    operator: Identity
    public: str
    agent: str
    action: str = ""
    """Id of a running action."""
    epoch: int = 0
    """Epoch of the lease that ``operator`` holds."""
    code: str = ""
    """Claim code of an unclaimed agent."""

    @property
    def device(self) -> str:
        return f"{self.agent}-arm"


async def person(functions: Functions, name: str) -> Identity:
    return Identity((await functions.sign_in.account(name)).id, name, f"session of {name}")


async def paired(functions: Functions, operator: Identity, **more: Any) -> Scene:
    public = new_public_key()
    agent, code = await show_code(functions, public=public)
    await functions.claim.claim(operator, code, None)
    return Scene(operator, public, agent, **more)


async def idle(functions: Functions) -> Scene:
    return await paired(functions, await person(functions, "anna"))


async def running(functions: Functions) -> Scene:
    scene = await idle(functions)
    lease, *_ = await functions.leases.acquire(scene.operator, scene.device, epoch=None, lease_ms=600_000, wait_ms=0)
    action, _ = await functions.start_action.start(scene.operator, scene.device, action_request(epoch=lease.epoch))
    return Scene(scene.operator, scene.public, scene.agent, action.id, lease.epoch)


async def queued(functions: Functions) -> Scene:
    scene = await running(functions)
    for _ in range(2):
        await functions.start_action.start(
            scene.operator, scene.device, action_request(epoch=scene.epoch, policy="queue")
        )
    return scene


async def control_requested(functions: Functions) -> Scene:
    """Another session requests the lease that ``operator`` holds; ``action`` is the id of the request."""
    scene = await running(functions)
    other = Identity(scene.operator.account, scene.operator.name, "another session")
    _, control_request, _, _ = await functions.control_requests.create(
        other, scene.device, within_ms=60_000, lease_ms=9_000, wait_ms=0
    )
    return Scene(scene.operator, scene.public, scene.agent, control_request.id, scene.epoch)


async def unclaimed(functions: Functions) -> Scene:
    public = new_public_key()
    agent, code = await show_code(functions, public=public)
    # Each robot has another owner, because a killed claim counts as an attempt.
    return Scene(await person(functions, f"owner of {agent}"), public, agent, code=code)


async def start(functions: Functions, scene: Scene) -> None:
    await functions.start_action.start(scene.operator, scene.device, action_request())


async def start_refused(functions: Functions, scene: Scene) -> None:
    with pytest.raises(Problem, match="is running"):
        await start(functions, scene)


async def start_with_key(functions: Functions, scene: Scene) -> None:
    await functions.start_action.start(scene.operator, scene.device, action_request(), idempotency_key="key")


async def join_queue(functions: Functions, scene: Scene) -> None:
    await functions.start_action.start(
        scene.operator, scene.device, action_request(policy="queue", epoch=scene.epoch or None), idempotency_key="key"
    )


async def cancel(functions: Functions, scene: Scene) -> None:
    await functions.actions.cancel(scene.operator, scene.action)


async def report_done(functions: Functions, scene: Scene) -> None:
    await report(functions, scene.action, AckStatus.DONE)


async def report_failed(functions: Functions, scene: Scene) -> None:
    await report(functions, scene.action, AckStatus.FAILED)


async def take(functions: Functions, scene: Scene) -> None:
    await functions.leases.acquire(scene.operator, scene.device, epoch=None, lease_ms=5_000, wait_ms=0)


async def release(functions: Functions, scene: Scene) -> None:
    await functions.leases.release(scene.operator, scene.device, epoch=scene.epoch)


async def pass_control(functions: Functions, scene: Scene) -> None:
    await functions.control_requests.accept(scene.operator, scene.device, scene.action, wait_ms=0)
    lease = await functions.leases.get(scene.operator, scene.device)
    assert lease is not None
    assert (lease.epoch, lease.session) == (scene.epoch + 1, "another session")


async def stop(functions: Functions, scene: Scene) -> None:
    await functions.stop.stop(scene.operator, scene.device, "enough")


async def unpair(functions: Functions, scene: Scene) -> None:
    await functions.unpair.unpair(scene.operator, scene.agent)


async def claim(functions: Functions, scene: Scene) -> None:
    await functions.claim.claim(scene.operator, scene.code, None)


async def time_out(functions: Functions, _scene: Scene) -> None:
    """Run the timer after all time limits."""
    cast("SetClock", functions.clock).advance(TIMEOUT_S + QUEUE_S)
    await functions.scheduler.run_due_jobs()


async def report(functions: Functions, action: str, status: AckStatus) -> None:
    device = action.rpartition("-")[0]
    agent, _, name = device.partition("-")
    at_ms = functions.clock.now_ms()
    ack = Ack(id=action, status=status, sequence=1, at_ms=at_ms, tick_ms=at_ms)
    topic = topics.parse(topics.device("space", agent, name, topics.ACK))
    await functions.action_acks.ingest(topic, codec.encode(ack), by="mqtt")


CASES: dict[str, tuple[Callable[[Functions], Awaitable[Scene]], Work, int]] = {
    "start": (idle, start, 4),
    "start with a key": (idle, start_with_key, 4),
    "start rejected": (running, start_refused, 1),
    "join the queue": (queued, join_queue, 3),
    "queue while idle": (idle, join_queue, 4),
    "cancel": (running, cancel, 2),
    "report done": (running, report_done, 1),
    "report done before a queue": (queued, report_done, 4),
    "report failed before a queue": (queued, report_failed, 4),
    "take": (idle, take, 2),
    "take again": (running, take, 2),
    "release": (running, release, 2),
    "hand over": (control_requested, pass_control, 3),
    "stop before a queue": (queued, stop, 4),
    "un-pair": (queued, unpair, 4),
    "claim": (unclaimed, claim, 4),
    "timer": (queued, time_out, 4),
}


async def rows_of(functions: Functions, table: str, partition: str) -> dict[str, dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {}
    cursor = None
    while True:
        page = await functions.tables.query(table, partition, limit=1000, cursor=cursor)
        rows |= {row.key: dict(row.data) for row in page.rows}
        cursor = page.cursor
        if cursor is None:
            return rows


async def settle(functions: Functions, scenes: list[Scene]) -> None:
    """Advance time and run the timer until every time limit has passed; then the devices report unknown outcomes."""
    clock = cast("SetClock", functions.clock)
    for step_s in (*([1.0] * (TIMEOUT_S + QUEUE_S + 12)), *([ORPHAN_MS / 2000 + 1] * 3)):
        clock.advance(step_s)
        await functions.scheduler.run_due_jobs()
    for scene in scenes:
        for data in (await rows_of(functions, records.CONTROL, scene.device)).values():
            if data.get("status") == "unknown":
                await report(functions, data["id"], AckStatus.EXPIRED)
    clock.advance(ORPHAN_MS / 1000)
    await functions.scheduler.run_due_jobs()
    reminders = [key for shard in range(SHARDS) for key in await rows_of(functions, records.PENDING, str(shard))]
    # A longer lease has a reminder of its end; an audit chain has an hourly one.
    reminders = [key for key in reminders if ":anchor:" not in key]
    leases = [key for key in reminders if ":lease:" in key]
    assert reminders == leases
    assert len(leases) == len({key.rpartition(":")[2] for key in leases})


async def check_scenes(functions: Functions, place: Place, scenes: list[Scene]) -> None:
    """Assert that no action is open, that each sent command is stored, and that every robot can be used."""
    await settle(functions, scenes)
    sent = commands_sent(place)
    for command, payloads in sent.items():
        assert len(payloads) == 1, f"{command} was sent with different contents"
    stored = set()
    for scene in scenes:
        rows = await rows_of(functions, records.CONTROL, scene.device)
        for key, data in rows.items():
            if key.startswith("action:"):
                assert data["status"] in TERMINAL, data
                stored.add(data["id"])
            assert not key.startswith("event:"), "an event was not published"
        assert rows.get("now:slot", {"action": ""})["action"] == ""
        assert not rows.get("now:queue", {"actions": ()})["actions"]
    assert actions_sent(sent) <= stored, "a command was sent without being stored"
    for scene in scenes:
        public, agent = scene.public, scene.agent
        _, code = await show_code(functions, public=public)
        owner = scene.operator
        if code:
            owner = await person(functions, f"next owner of {agent}")
            await functions.claim.claim(owner, code, None)
            assert (await functions.actions.list(owner, scene.device, cursor=None, limit=10))[0] == []
        row = await functions.tables.get(records.AGENTS, agent, "agent")
        assert row is not None
        owner = Identity(row.data["account"], "former owner", owner.session)
        action, _ = await functions.start_action.start(owner, scene.device, action_request())
        assert action.status.value == "published"
        await report(functions, action.id, AckStatus.DONE)
        lease, *_ = await functions.leases.acquire(owner, scene.device, epoch=None, lease_ms=5_000, wait_ms=0)
        assert lease.epoch > action.epoch >= max(1, scene.epoch)


def actions_sent(sent: dict[str, set[bytes]]) -> set[str]:
    """Ids of the commands that start an action."""
    runs = (b'"kind":"move_joints"', b'"kind":"run_movement"')
    return {command for command, payloads in sent.items() if any(kind in one for kind in runs for one in payloads)}
