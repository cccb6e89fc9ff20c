"""Signing keys change during a session."""

from typing import Any

import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.protocol import AckStatus, Mode, RotateKey, RunMovement, RunTrial, State, codec, topics
from device_agent.protocol.security import signing
from device_agent.protocol.security.key_rotation import KEYS_CONTEXT, NewKey
from function_app.entrypoints.ingest.router import ingest
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import Cloud, Person
from tests.unit.function_app.services.robot_types.movements import MINE, SOURCE

Pair = tuple[Person, Robot]
LEARN_S, OVERLAP_S = 1800, 86_400
WAIT_MS = 20_000


def rotate(cloud: Cloud, **options: Any) -> str:
    """Rotate the signing key; return the id of the new key."""
    options = options or {"learn_ms": LEARN_S * 1000, "overlap_ms": OVERLAP_S * 1000}
    return cloud.run(cloud.functions.keys.rotate(**options)).pins[-1].id


def old_key(cloud: Cloud) -> Ed25519PrivateKey:
    return cloud.run(cloud.functions.keys.current())


def follow(robot: Robot) -> None:
    """Store new keys from the announcements in the response with MQTT credentials."""
    response = robot.request("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
    for statement in response["key_statements"]:
        announcement = codec.decode(signing.verify(statement.encode(), robot._keys, context=KEYS_CONTEXT), NewKey)
        key = signing.public_key(announcement.key)
        robot._keys[signing.key_id(key)] = key


def run(person: Person, robot: Robot) -> None:
    request = {"kind": "run_movement", "name": "mine"}
    started = person.start(robot.device, request=request, wait_for="started", wait_ms=WAIT_MS).json()
    assert started["status"] == "started", started
    robot.report(started["id"], AckStatus.DONE)
    assert person.action(started["id"], wait_ms=WAIT_MS, wait_for="done")["status"] == "done"


def state(tick_ms: int) -> State:
    return State(device="arm", mode=Mode.IDLE, epoch=0, at_ms=1, tick_ms=tick_ms)


def publish_states(robot: Robot) -> None:
    for tick_ms in range(3):
        robot.publish_state(state(tick_ms))


def test_a_session_continues_through_a_rotation(pair: Pair, cloud: Cloud, open_cloud: OpenCloud) -> None:
    anna, robot = pair
    old = signing.key_id(old_key(cloud).public_key())
    assert anna.put(MINE, {"source": SOURCE}).status_code == 201
    assert anna.take_lease(robot.device).json()["confirmed"]
    new = rotate(cloud)
    follow(robot)
    for ahead_s, signer in ((1, old), (LEARN_S, new)):
        cloud.clock.advance(ahead_s)
        assert anna.get("/devices").status_code == 200
        assert anna.take_lease(robot.device, take_over=True, reason="on").json()["confirmed"]
        run(anna, robot)
        order = robot.received(RunMovement)[-1].request
        assert isinstance(order, RunMovement)
        assert order.key == signer
        text = signing.movement_text(order.robot_type, order.name, order.version, order.sha256)
        signing.verify_text(text, order.signature, robot._keys[signer], context=signing.MOVEMENT_CONTEXT)
    assert robot.link is not None
    robot.link.close()
    robot.connect()
    cloud.clock.advance(OVERLAP_S)
    later = open_cloud(clock=cloud.clock)
    later.start_ingest()
    again = later.sign_in("anna")
    assert again.get(MINE).status_code == 200, "movements signed with an old key remain readable"
    assert again.take_lease(robot.device, take_over=True, reason="on").json()["confirmed"]
    run(again, robot)


def test_the_movement_of_a_trial_is_signed_with_the_new_key(cloud: Cloud, anna: Person) -> None:
    path = "/robot-types/ur5_gripper/movements/pick_and_place"
    assert anna.put(path, {"source": anna.get(path).json()["source"]}).status_code == 201
    robot = cloud.robot()
    robot.robot_type = "ur5_gripper"
    robot.pair(anna)
    robot.connect()
    new = rotate(cloud)
    follow(robot)
    cloud.clock.advance(LEARN_S)
    anna.start(robot.device, request={"kind": "run_trial", "name": "red_cube_in_green_tray", "seed": 1}, wait_ms=0)
    cloud.settle()
    (command,) = robot.received(RunTrial)
    assert isinstance(command.request, RunTrial)
    order = command.request.movement
    assert order.key == new
    text = signing.movement_text(order.robot_type, order.name, order.version, order.sha256)
    signing.verify_text(text, order.signature, robot._keys[new], context=signing.MOVEMENT_CONTEXT)


def get_devices(cloud: Cloud, token: str) -> int:
    return cloud.request("GET", "/api/v1/devices", headers={"Authorization": f"Bearer {token}"}).status_code


def test_a_token_of_an_old_key_is_valid_until_the_end_of_the_overlap(cloud: Cloud, open_cloud: OpenCloud) -> None:
    token, key = cloud.sign_in("anna").token, old_key(cloud)
    rotate(cloud)
    other = open_cloud()
    assert get_devices(other, token) == 200
    cloud.clock.advance(OVERLAP_S)
    now_s = cloud.clock.now_ms() // 1000
    claims = jwt.decode(token, options={"verify_signature": False}) | {"iat": now_s, "exp": now_s + 600}
    forged = jwt.encode(claims, key, "EdDSA", headers={"kid": signing.key_id(key.public_key())})
    assert get_devices(cloud, forged) == get_devices(other, forged) == 401
    assert cloud.sign_in("anna").get("/devices").status_code == 200


def test_tokens_of_a_leaked_key_are_rejected_in_all_instances(cloud: Cloud, open_cloud: OpenCloud) -> None:
    token, other = cloud.sign_in("anna").token, open_cloud()
    assert get_devices(cloud, token) == get_devices(other, token) == 200
    rotate(cloud, leaked=True)
    cloud.clock.advance(6)  # a result of a recent check is valid for some seconds
    assert get_devices(cloud, token) == get_devices(other, token) == 401


def test_a_new_key_is_announced_in_a_command_signed_with_the_old_key(pair: Pair, cloud: Cloud) -> None:
    _, robot = pair
    publish_states(robot)
    assert robot.received(RotateKey) == []
    new = rotate(cloud)
    publish_states(robot)
    (command,) = robot.received(RotateKey)
    assert (command.epoch, command.caller) == (0, "telescope")
    order = command.request
    assert isinstance(order, RotateKey)
    (statement,) = order.statements
    announcement = codec.decode(signing.verify(statement.encode(), robot._keys, context=KEYS_CONTEXT), NewKey)
    assert signing.key_id(signing.public_key(announcement.key)) == new


def test_each_new_key_is_announced_once_until_it_signs_commands(pair: Pair, cloud: Cloud) -> None:
    _, robot = pair
    for number in (1, 2):
        rotate(cloud)
        publish_states(robot)
        cloud.clock.advance(LEARN_S)
        publish_states(robot)
        assert len(robot.received(RotateKey)) == number
        follow(robot)


def test_an_announcement_that_failed_is_repeated(pair: Pair, cloud: Cloud, broker: MemoryBroker) -> None:
    _, robot = pair
    rotate(cloud)
    for broker.reachable, number in ((False, 0), (True, 1), (True, 1)):
        cloud.run(ingest(cloud.functions, robot.topic(topics.STATE), codec.encode(state(number))))
        assert len(robot.received(RotateKey)) == number


def test_an_agent_claimed_during_an_overlap_pins_both_keys(cloud: Cloud) -> None:
    rotate(cloud)
    robot = cloud.robot("arm")
    robot.pair(cloud.sign_in("anna"))
    (first, second) = robot.enrollment()["keys"]
    assert (first["serial"], second["serial"]) == (1, 2)
    assert first["until_ms"] == pytest.approx(cloud.clock.now_ms() + OVERLAP_S * 1000, abs=60_000)
    assert second["until_ms"] == 0


def test_an_agent_offline_during_the_whole_overlap_gets_no_statement(pair: Pair, cloud: Cloud) -> None:
    _, robot = pair
    new = rotate(cloud)
    cloud.clock.advance(OVERLAP_S)
    state = robot.enrollment()
    assert state["key_statements"] == []
    assert state["signing_key"] == new
    assert [key["id"] for key in state["keys"]] == [new]
    assert new not in robot._keys
