"""An agent downloads the robot type of its account, and uses it only with a valid signature."""

import base64
from pathlib import Path

import pytest

from device_agent.config.errors import ConfigError
from device_agent.config.robot_type_store import RobotTypeStore
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.package import CONTEXT
from device_agent.protocol.security import signing
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.integration.robot_types.lever import add, manifest

Package = tuple[bytes, dict[str, bytes]]


def claimed_with_keys(cloud: Cloud, owner: Person) -> Robot:
    """A robot with a lever, claimed by the owner; it has pinned the keys of the cloud."""
    robot = cloud.robot()
    lever = [{"name": "arm", "kind": "arm", "robot_type": "lever", "label": "Arm"}]
    code = robot.enroll(devices=lever).json()["claim_code"]
    assert owner.post("/agents/claim", {"code": code}).status_code == 200
    robot._keys = {key["id"]: signing.public_key(key["public"]) for key in robot.enrollment()["keys"]}
    return robot


def download(robot: Robot) -> Package:
    answer = robot.request("GET", f"/agents/{robot.id}/robot-types/lever")
    assert answer.status_code == 200, answer.text
    body = answer.json()
    return body["statement"].encode(), {name: base64.b64decode(text) for name, text in body["files"].items()}


@pytest.mark.usefixtures("checker")
def test_a_saved_type_is_downloaded_updated_and_rejected_if_it_was_changed(
    cloud: Cloud, anna: Person, tmp_path: Path
) -> None:
    assert add(anna).status_code == 201
    robot = claimed_with_keys(cloud, anna)
    types = RobotTypeStore(tmp_path / "types", agent=robot.id, keys=robot._keys)
    first = download(robot)
    assert types.install("lever", *first)
    assert not types.install("lever", *first)
    assert robot_type.load(tmp_path / "types" / "lever").label == "Lever"

    assert add(anna, text=manifest(label='"Long lever"')).status_code == 200
    statement, files = download(robot)
    foreign = signing.sign(signing.verify(statement, robot._keys, context=CONTEXT), signing.generate(), context=CONTEXT)
    changed = {**files, "lever.xml": files["lever.xml"] + b" "}
    other = RobotTypeStore(tmp_path / "types", agent="other", keys=robot._keys)
    for store, package, reason in (
        (types, (foreign, files), "has not pinned"),
        (types, (statement, changed), "do not match the signed hashes"),
        (types, (statement, {**files, "../evil": b""}), "do not match the signed hashes"),
        (other, (statement, files), "for another agent"),
    ):
        with pytest.raises(ConfigError, match=reason):
            store.install("lever", *package)
        assert robot_type.load(tmp_path / "types" / "lever").label == "Lever", "the stored version stays"
    assert types.install("lever", statement, files)
    assert robot_type.load(tmp_path / "types" / "lever").label == "Long lever"
    with pytest.raises(ConfigError, match="is older than version 2"):
        types.install("lever", *first)


@pytest.mark.usefixtures("checker")
def test_an_agent_gets_only_the_types_of_its_own_devices(cloud: Cloud, anna: Person) -> None:
    assert add(anna).status_code == 201
    robot = claimed_with_keys(cloud, anna)
    assert robot.request("GET", f"/agents/{robot.id}/robot-types/ur5").status_code == 404
    stranger = claimed_with_keys(cloud, cloud.sign_in("bert"))
    assert stranger.request("GET", f"/agents/{robot.id}/robot-types/lever").status_code == 404
    assert stranger.request("GET", f"/agents/{stranger.id}/robot-types/lever").status_code == 404, "of another account"
