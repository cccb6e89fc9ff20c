"""A complete agent with the simulated UR5 works during a rotation of the cloud's keys, and the old key expires."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from device_agent.protocol import GrantLease
from device_agent.protocol.security import signing
from function_app.adapters.local.signing_keys import FileKeys
from function_app.adapters.shared.key_ring import Ring
from tests.contract.transports.agent_suite import PairedAgent
from tests.contract.transports.suite import Spoken
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import wait_until

LEARN_MS, OVERLAP_MS = 3_600_000, 7_200_000
SOURCE = '"""Nod."""\nrobot.move_joints({"wrist_1": -1.5})\n'


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[CloudProcesses]:
    with start_cloud_processes("amqtt", tmp_path) as processes:
        yield processes


@pytest.fixture
def agent(processes: CloudProcesses, tmp_path: Path) -> Iterator[PairedAgent]:
    agent = PairedAgent(processes, Spoken(endpoint="broker", notices_s=10.0), tmp_path / "agent")
    yield agent
    agent.stop()


def require_operation(processes: CloudProcesses, agent: PairedAgent) -> None:
    """Takes a lease, moves, and runs a movement."""
    epoch = agent.take()
    moved = agent.move({"shoulder_pan": 0.1}, epoch=epoch, wait_for="done")
    assert moved["status"] == "done", moved
    request = {"kind": "run_movement", "name": "nod"}
    ran = processes.anna.start(agent.id, request=request, epoch=epoch, wait_for="done", wait_ms=30_000).json()
    assert ran["status"] == "done", ran


def rejections(agent: PairedAgent) -> dict[str, int]:
    """Number of rejected commands by reason."""
    return dict(agent.device.publisher.rejections)


def rejections_of(processes: CloudProcesses, agent: PairedAgent, key: Any) -> dict[str, int]:
    """Sends a lease that is signed with this key, and returns the new rejections."""
    epoch = agent.device._controller.epochs[0] + 1
    lease = GrantLease(holder="anna", lease_ms=30_000)
    before = rejections(agent)
    processes.deliver(agent.agent, processes.command(agent.agent, lease, epoch=epoch, key=key))
    wait_until(lambda: rejections(agent) != before or agent.device._controller.epochs[0] == epoch, "a response")
    return {code: count - before.get(code, 0) for code, count in rejections(agent).items()}


def test_a_running_agent_follows_a_rotation_and_rejects_the_old_key_afterwards(
    processes: CloudProcesses, agent: PairedAgent
) -> None:
    keys = FileKeys(processes.home / "keys")
    old = keys.load()
    pins: Any = agent.device._commands._keys
    assert processes.anna.put("/robot-types/ur5/movements/nod", {"source": SOURCE}).status_code == 201
    require_operation(processes, agent)

    rotation = processes.cloud.run(processes.cloud.functions.keys.rotate(learn_ms=LEARN_MS, overlap_ms=OVERLAP_MS))
    new = rotation.pins[-1].id
    require_operation(processes, agent)
    wait_until(lambda: pins.serial == 2, "the agent to pin the new key")
    assert new in pins
    pairing = agent.store.pairing()
    assert pairing is not None
    assert new in pairing.keys
    assert rotation.signing == signing.key_id(old.public_key())

    ring = keys._parse()
    keys._write(Ring((*ring.keys[:-1], replace(ring.newest, devices_from_ms=0))))  # as after LEARN_MS
    assert signing.key_id(processes.cloud.run(processes.cloud.functions.keys.for_devices()).public_key()) == new
    require_operation(processes, agent)
    assert rejections(agent) == {}

    assert rejections_of(processes, agent, old) == {}, "the old key is valid during the overlap"
    now_ms = pins._now_ms
    pins._now_ms = lambda: (now_ms() or 0) + OVERLAP_MS
    assert rejections_of(processes, agent, old) == {"bad_signature": 1}
    pins._now_ms = now_ms
