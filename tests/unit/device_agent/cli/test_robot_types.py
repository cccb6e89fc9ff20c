"""Robot types that are not on the machine are downloaded before the devices start."""

import hashlib
import os
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent import bootstrap
from device_agent.cli import robot_types
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.protocol import codec
from device_agent.protocol.manifests import package
from device_agent.protocol.manifests.package import RobotTypePackage
from device_agent.protocol.security import signing
from device_agent.transports.http.client import CloudError
from tests.integration.robot_types.lever import FILES, manifest

KEY = signing.generate()


class MemoryCloud:
    """A cloud with one robot type. ``errors``: raised by the next requests."""

    def __init__(self) -> None:
        self.version = 1
        self.errors: list[Exception] = []
        self.enrolled: list[dict[str, str]] = []

    def enroll(self, *, devices: list[dict[str, str]], **_: Any) -> None:
        self.enrolled = devices

    def robot_type(self, agent: str, name: str) -> tuple[bytes, dict[str, bytes]]:
        if self.errors:
            raise self.errors.pop(0)
        text = manifest(label=f'"Lever {self.version}"')
        files = {each: content.encode() for each, content in {**FILES, "robot.toml": text}.items()}
        hashes = {each: hashlib.sha256(content).hexdigest() for each, content in files.items()}
        stated = RobotTypePackage(agent=agent, type=name, version=self.version, files=hashes)
        return signing.sign(codec.encode(stated), KEY, context=package.CONTEXT), files


@pytest.fixture
def cloud(monkeypatch: pytest.MonkeyPatch) -> MemoryCloud:
    cloud = MemoryCloud()
    monkeypatch.setattr(bootstrap, "cloud_client", lambda *_: cloud)
    monkeypatch.setattr(robot_types, "_RETRY_S", 0.0)
    monkeypatch.setenv(catalogue.ROBOTS_PATH, os.environ.get(catalogue.ROBOTS_PATH, ""))
    return cloud


@pytest.fixture
def store(tmp_path: Path) -> IdentityStore:
    store = IdentityStore(tmp_path / "agent")
    config = AgentConfig(
        server="http://127.0.0.1:1",
        name="lab",
        devices=(DeviceEntry(name="left", type="lever"), DeviceEntry(name="arm", type="ur5")),
    )
    config.save(store.folder)
    keys = {signing.key_id(KEY.public_key()): signing.public_text(KEY.public_key())}
    store.save_pairing(Pairing(agent="a1", space="s", account="anna", keys=keys))
    return store


def label() -> str:
    return catalogue.TYPES.load("lever").label


def test_a_missing_type_is_downloaded_and_updated_at_each_start(cloud: MemoryCloud, store: IdentityStore) -> None:
    cloud.errors = [OSError("no network"), CloudError("busy", passing=True)]
    robot_types.update(store)
    assert label() == "Lever 1"
    assert [(each["robot_type"], each["kind"]) for each in cloud.enrolled] == [("lever", "robot"), ("ur5", "arm")]
    cloud.version = 2
    for error in (OSError("no network"), CloudError("gone", "robot-type-unknown")):
        cloud.errors = [error]
        robot_types.update(store)
        assert label() == "Lever 1", "the stored version is used"
    robot_types.update(store)
    assert label() == "Lever 2"


def test_a_type_that_the_account_does_not_have_is_an_error(cloud: MemoryCloud, store: IdentityStore) -> None:
    cloud.errors = [CloudError("There is no robot type 'lever'.", "robot-type-unknown")]
    with pytest.raises(ConfigError, match=r"'lever' is not on this machine \(known: .*ur5.*\), and .*: There is no"):
        robot_types.update(store)


def test_a_device_type_is_not_downloaded(cloud: MemoryCloud, store: IdentityStore) -> None:
    config = AgentConfig.load(store.folder)
    camera = DeviceEntry(name="door", type="camera", driver="mjpeg", options={"url": "http://door/"})
    msgspec.structs.replace(config, devices=(camera,)).save(store.folder)
    cloud.errors = [CloudError("There is no robot type 'camera'.", "robot-type-unknown")]
    robot_types.update(store)
    assert not cloud.enrolled
