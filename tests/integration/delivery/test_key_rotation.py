"""Signing keys change while people and robots are at work."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.protocol import AckStatus, Mode, RotateKey, RunMovement, State, codec
from device_agent.protocol.security import signing
from device_agent.protocol.security.key_rotation import KEYS_CONTEXT, NewKey
from function_app.adapters.local.signing_keys import FileKeys
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.network.brokers import RunningBroker, start_broker, wait_until
from tests.integration.conftest import OpenCloud
from tests.unit.function_app.services.robot_types.movements import MINE, SOURCE

LEARN_S, OVERLAP_S = 1800, 86_400
WAIT_MS = 20_000


@pytest.fixture
def broker(home: Path, tmp_path: Path) -> Iterator[RunningBroker]:
    """One that reads the very keys that change."""
    with start_broker("amqtt", tmp_path / "broker", keys=home / "keys" / "public.json") as broker:
        yield broker


@pytest.fixture
def alone(open_cloud: OpenCloud) -> Cloud:
    """The functions without a broker."""
    return open_cloud()


def rotate(cloud: Cloud, **options: Any) -> str:
    """The new key's id."""
    options = options or {"learn_ms": LEARN_S * 1000, "overlap_ms": OVERLAP_S * 1000}
    return cloud.run(cloud.functions.keys.rotate(**options)).pins[-1].id


def old_key(cloud: Cloud) -> Ed25519PrivateKey:
    return cloud.run(cloud.functions.keys.current())


def follow(robot: Robot) -> None:
    """Learn as an agent does, from the key announcement it receives with its credentials."""
    given = robot.ask("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
    for statement in given["key_statements"]:
        told = codec.decode(signing.verify(statement.encode(), robot._keys, context=KEYS_CONTEXT), NewKey)
        half = signing.public_key(told.key)
        robot._keys[signing.key_id(half)] = half


def run(person: Person, robot: Robot) -> None:
    request = {"kind": "run_movement", "name": "mine"}
    started = person.start(robot.device, request=request, wait_for="started", wait_ms=WAIT_MS).json()
    assert started["status"] == "started", started
    robot.report(started["id"], AckStatus.DONE)
    assert person.action(started["id"], wait_ms=WAIT_MS, wait_for="done")["status"] == "done"


def test_a_session_goes_on_through_a_rotation(pair: tuple[Person, Robot], cloud: Cloud, open_cloud: OpenCloud) -> None:
    anna, robot = pair
    old = signing.key_id(old_key(cloud).public_key())
    assert anna.put(MINE, {"source": SOURCE}).status_code == 201
    assert anna.take(robot.device).json()["confirmed"]
    new = rotate(cloud)
    follow(robot)
    for ahead_s, signer in ((1, old), (LEARN_S, new)):
        cloud.clock.advance(ahead_s)
        assert anna.get("/devices").status_code == 200
        assert anna.take(robot.device, take_over=True, reason="on").json()["confirmed"]
        run(anna, robot)
        ran = robot.heard(RunMovement)[-1].request
        assert isinstance(ran, RunMovement)
        assert ran.key == signer
        text = signing.movement_text(ran.robot_type, ran.name, ran.version, ran.sha256)
        signing.verify_text(text, ran.signature, robot._keys[signer], context=signing.MOVEMENT_CONTEXT)
    # Everybody has new credentials long before: the broker cuts who comes by old ones when the old key is over.
    assert robot.link is not None
    robot.link.close()
    robot.connect()
    cloud.clock.advance(OVERLAP_S)
    later = open_cloud(clock=cloud.clock)
    later.start_ingest()
    again = later.sign_in("anna")
    assert again.get(MINE).status_code == 200, "what was saved with an old key is still there"
    assert again.take(robot.device, take_over=True, reason="on").json()["confirmed"]
    run(again, robot)


def test_a_token_of_an_old_key_counts_until_that_is_over(alone: Cloud, open_cloud: OpenCloud) -> None:
    anna, key = alone.sign_in("anna"), old_key(alone)
    rotate(alone)
    other = open_cloud(clock=alone.clock)
    claims = {"Authorization": f"Bearer {anna.token}"}
    assert other.ask("GET", "/api/v1/devices", headers=claims).status_code == 200
    alone.clock.advance(OVERLAP_S)
    now_s = alone.clock.now_ms() // 1000
    forged = jwt.decode(anna.token, options={"verify_signature": False}) | {"iat": now_s, "exp": now_s + 600}
    token = jwt.encode(forged, key, "EdDSA", headers={"kid": signing.key_id(key.public_key())})
    for instance in (alone, other):
        assert instance.ask("GET", "/api/v1/devices", headers={"Authorization": f"Bearer {token}"}).status_code == 401
    assert alone.sign_in("anna").get("/devices").status_code == 200


def test_a_key_that_has_leaked_ends_tokens_at_once_everywhere(alone: Cloud, open_cloud: OpenCloud) -> None:
    anna, other = alone.sign_in("anna"), open_cloud(clock=alone.clock)
    headers = {"Authorization": f"Bearer {anna.token}"}
    assert other.ask("GET", "/api/v1/devices", headers=headers).status_code == 200
    assert anna.get("/devices").status_code == 200
    rotate(alone, leaked=True)
    alone.clock.advance(6)  # what was looked at lately is looked at again
    assert other.ask("GET", "/api/v1/devices", headers=headers).status_code == 401
    assert anna.get("/devices").status_code == 401


def test_an_agent_is_told_by_an_order_that_the_old_key_signed(pair: tuple[Person, Robot], cloud: Cloud) -> None:
    anna, robot = pair
    new = rotate(cloud)
    for tick in range(3):
        robot.say_state(State(device="arm", mode=Mode.IDLE, epoch=0, at_ms=tick, tick_ms=tick))
    wait_until(lambda: robot.heard(RotateKey) != [], "the order")
    anna.take(robot.device)  # sent after every earlier command
    assert len(robot.heard(RotateKey)) == 1
    order = robot.heard(RotateKey)[0].request
    assert isinstance(order, RotateKey)
    (statement,) = order.statements
    told = codec.decode(signing.verify(statement.encode(), robot._keys, context=KEYS_CONTEXT), NewKey)
    assert signing.key_id(signing.public_key(told.key)) == new


def test_who_is_claimed_during_an_overlap_pins_both_and_when_the_first_ends(alone: Cloud) -> None:
    rotate(alone)
    robot = alone.robot("arm")
    robot.pair(alone.sign_in("anna"))
    (first, second) = robot.enrollment()["keys"]
    assert (first["serial"], second["serial"]) == (1, 2)
    assert first["until_ms"] == pytest.approx(alone.clock.now_ms() + OVERLAP_S * 1000, abs=60_000)
    assert second["until_ms"] == 0


def test_who_was_away_for_the_whole_overlap_is_told_nothing_it_could_believe(
    pair: tuple[Person, Robot], cloud: Cloud
) -> None:
    _, robot = pair
    new = rotate(cloud)
    cloud.clock.advance(OVERLAP_S)
    state = robot.enrollment()
    assert state["key_statements"] == []
    assert state["signing_key"] == new
    assert [key["id"] for key in state["keys"]] == [new]
    assert new not in robot._keys


def test_the_blobs_address_of_before_still_leads_there(alone: Cloud) -> None:
    blobs = alone.functions.blobs
    alone.run(blobs.put("a", b"content"))
    url = alone.run(blobs.presign_download("a", content_type="text/plain", lifetime_s=60))
    rotate(alone)
    assert alone.ask("GET", url).content == b"content"


def test_another_process_rotates_and_this_one_signs_with_the_new_key(alone: Cloud, open_cloud: OpenCloud) -> None:
    home = alone.functions.settings.home
    before = alone.sign_in("anna").token
    asyncio.run(FileKeys(home / "keys", now_ms=alone.clock.now_ms).rotate())
    after = alone.sign_in("anna").token
    kids = [jwt.get_unverified_header(token)["kid"] for token in (before, after)]
    assert kids[0] != kids[1]
    assert (
        open_cloud(clock=alone.clock)
        .ask("GET", "/api/v1/devices", headers={"Authorization": f"Bearer {after}"})
        .status_code
        == 200
    )
