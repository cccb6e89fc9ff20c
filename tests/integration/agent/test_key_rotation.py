"""A whole agent with the simulated UR5 goes on through a rotation of the cloud's keys, and the old one ends."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from device_agent.protocol import GrantLease
from device_agent.protocol.security import signing
from function_app.adapters.local.signing_keys import FileKeys
from function_app.adapters.shared.key_ring import Ring
from tests.contract.transports.agent_suite import Resident
from tests.contract.transports.suite import Spoken
from tests.harness.cloud.cloud_processes import Ground, start_ground
from tests.harness.network.brokers import wait_until

LEARN_MS, OVERLAP_MS = 3_600_000, 7_200_000
MOVEMENT = "/robot-types/ur5/movements/nod"
SOURCE = '"""Nod."""\nrobot.move_joints({"wrist_1": -1.5})\n'


@pytest.fixture
def ground(tmp_path: Path) -> Iterator[Ground]:
    with start_ground("amqtt", tmp_path) as ground:
        yield ground


@pytest.fixture
def resident(ground: Ground, tmp_path: Path) -> Iterator[Resident]:
    resident = Resident(ground, Spoken(endpoint="broker", notices_s=10.0), tmp_path / "agent")
    yield resident
    resident.stop()


def work(ground: Ground, resident: Resident) -> None:
    """A lease, a command and a movement, with a token: nothing of it is refused."""
    epoch = resident.take()
    moved = resident.move({"shoulder_pan": 0.1}, epoch=epoch, wait_for="done")
    assert moved["status"] == "done", moved
    request = {"kind": "run_movement", "name": "nod"}
    ran = ground.anna.start(resident.id, request=request, epoch=epoch, wait_for="done", wait_ms=30_000).json()
    assert ran["status"] == "done", ran


def learned(keys: FileKeys) -> None:
    """As if the time that devices have to learn were over."""

    def change(ring: Ring) -> Ring:
        return Ring((*ring.keys[:-1], replace(ring.newest, devices_from_ms=0)))

    ring = change(keys._parse())
    keys._write(ring)


def test_a_live_agent_goes_on_and_the_old_key_ends(ground: Ground, resident: Resident) -> None:
    keys = FileKeys(ground.home / "keys")
    old = keys.load()
    pins: Any = resident.device._commands._keys
    assert ground.anna.put(MOVEMENT, {"source": SOURCE}).status_code == 201
    work(ground, resident)

    news = ground.cloud.run(ground.cloud.functions.keys.rotate(learn_ms=LEARN_MS, overlap_ms=OVERLAP_MS))
    new = news.pins[-1].id
    work(ground, resident)
    wait_until(lambda: pins.serial == 2, "the agent to learn of the new key, while it works")
    assert new in pins
    pairing = resident.store.pairing()
    assert pairing is not None
    assert new in pairing.keys
    assert news.signing == signing.key_id(old.public_key())

    learned(keys)
    assert signing.key_id(ground.cloud.run(ground.cloud.functions.keys.for_devices()).public_key()) == new
    work(ground, resident)
    assert refusals(resident) == {}

    assert send(ground, resident, old) == {}, "while the overlap lasts the old key counts"
    now_ms = pins._now_ms
    pins._now_ms = lambda: (now_ms() or 0) + OVERLAP_MS
    assert send(ground, resident, old) == {"bad_signature": 1}
    pins._now_ms = now_ms


def refusals(resident: Resident) -> dict[str, int]:
    """How many commands the device has refused, and why."""
    found: dict[str, int] = dict(resident.device.publisher.rejections)
    return found


def send(ground: Ground, resident: Resident, key: Any) -> dict[str, int]:
    """Have the device hear a lease order signed with this key; what it has refused since."""
    epoch = resident.device._controller.epochs[0] + 1
    lease = GrantLease(holder="anna", lease_ms=30_000)
    order = ground.order(resident.agent, lease, epoch=epoch, key=key)
    before = refusals(resident)
    ground.deliver(resident.agent, order)
    wait_until(lambda: refusals(resident) != before or resident.device._controller.epochs[0] == epoch, "an answer")
    return {code: count - before.get(code, 0) for code, count in refusals(resident).items()}
