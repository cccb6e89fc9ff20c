"""Agent and server without a common version of the wire contract report which of them to update."""

import pytest

from device_agent.protocol import KINDS, PROTOCOL, Presence, VersionRange, topics
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import MOVE, Cloud, Person

LATER = {"min": PROTOCOL.max + 1, "max": PROTOCOL.max + 2}
UPDATE = "The agent supports protocol version 2 to 3, the server 1. Update the server."


def test_both_sides_exchange_versions_and_capabilities_at_enrolment(alone: Cloud) -> None:
    answer = alone.robot().enroll(protocol={"min": 1, "max": 9}, capabilities=["dance"], colour="red")
    assert answer.status_code == 201, "a newer agent with a common version and an unknown field is accepted"
    assert answer.json()["protocol"] == {"min": PROTOCOL.min, "max": PROTOCOL.max}
    assert answer.json()["capabilities"] == list(KINDS)


def test_an_agent_without_a_common_version_gets_no_claim_code(alone: Cloud) -> None:
    answer = alone.robot().enroll(protocol=LATER)
    assert (answer.status_code, answer.json()["detail"]) == (409, UPDATE)
    assert answer.json()["type"].endswith("/protocol-unsupported")


@pytest.mark.parametrize("way", ["enrolment", "presence"])
def test_the_owner_sees_which_side_to_update_and_no_action_starts(anna: Person, robot: Robot, way: str) -> None:
    path = f"/devices/{robot.device}"
    assert anna.get(path).json()["incompatible"] is None
    if way == "enrolment":
        assert robot.enroll(protocol=LATER).json()["detail"] == UPDATE
    else:
        later = Presence(online=True, session=robot.session + 1, at_ms=1, protocol=VersionRange(**LATER))
        robot.publish(topics.conn(robot.space, robot.id), later, retain=True)
    assert anna.get(path).json()["incompatible"] == UPDATE
    answer = anna.post(f"{path}/actions", {"request": MOVE})
    assert (answer.status_code, answer.json()["detail"]) == (409, UPDATE)
    robot.session += 1
    assert robot.enroll().status_code == 200
    robot.connect()
    assert anna.get(path).json()["incompatible"] is None
    assert anna.post(f"{path}/actions", {"request": MOVE}).status_code == 202


def test_a_request_that_the_agent_does_not_support_is_refused_before_it_is_sent(anna: Person, robot: Robot) -> None:
    present = Presence(online=True, session=robot.session + 1, at_ms=1, capabilities=("grant_lease", "say"))
    robot.publish(topics.conn(robot.space, robot.id), present, retain=True)
    answer = anna.post(f"/devices/{robot.device}/actions", {"request": MOVE})
    assert (answer.status_code, "'move_joints'" in answer.json()["detail"]) == (422, True)
    assert robot.received(object) == []
