"""``schemathesis run`` on the OpenAPI document: no server errors, and responses as documented."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import serialization

from device_agent.protocol import AckStatus, Fault, Measurements, Mode, State, topics
from device_agent.protocol.security import signing
from tests.harness.cloud.cloud import API, MOVE
from tests.harness.cloud.people import Visitor, sign_in
from tests.harness.cloud.polling import PollingRobot, Site
from tests.harness.hosts import Host, start_host
from tests.harness.network.brokers import RunningBroker
from tests.harness.paths import ROOT

CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "unsupported_method",
    "allow_header_conformance",
    "ignored_auth",
)


@pytest.fixture
def host(home: Path, broker: RunningBroker) -> Iterator[Host]:
    environment = {"TELESCOPE_HOME": str(home), "TELESCOPE_MQTT_PORT": str(broker.tcp_port)}
    with start_host("uvicorn", environment) as host:
        yield host


def pem(key: Any) -> str:
    text: bytes = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return text.decode()


def create_resources(host: Host, site: Site, anna: Visitor, another: Visitor, robot: PollingRobot) -> dict[str, Any]:
    """Create resources; returns their ids and credentials for the hooks."""
    spare = [PollingRobot(site) for _ in range(2)]
    for each in spare:
        each.pair(anna)
    assert anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"}).status_code == 201
    actions = []
    for device in robot.devices:
        response = anna.post(f"/devices/{device}/actions", {"request": MOVE, "wait_ms": 10_000})
        assert response.status_code == 200, response.text
        actions.append(response.json()["id"])
    robot.report(actions[0], AckStatus.DONE)
    now_ms = robot.cloud.clock.now_ms()
    measured = Measurements(tick_ms=now_ms, at_ms=now_ms, sequence=1, values={"temperature_c": 40.0})
    robot.publish(topics.device(robot.space, robot.id, "arm", topics.TELE, "health"), measured)
    fault = Fault(code="hot", message="The elbow is hot.", since_ms=now_ms)
    robot.publish_state(State(device="arm", at_ms=now_ms, tick_ms=now_ms, mode=Mode.IDLE, epoch=0, faults=(fault,)))
    host.tick()
    faults = anna.get(f"/devices/{robot.device}/faults").json()["items"]
    streams = anna.get(f"/devices/{robot.device}/data").json()["items"]
    assert len(faults) == len(streams) == 1
    controlled = robot.devices[-1]
    anna.post(f"/devices/{controlled}/lease", {"lease_ms": 600_000})
    request = another.post(f"/devices/{controlled}/lease/requests", {"within_ms": 120_000}).json()["request"]["id"]
    new_key = signing.generate()
    return {
        "url": host.url,
        "token": anna.token,
        "page": anna.page,
        "spare_token": another.token,
        "spare_page": another.page,
        "agent_key": pem(robot.key),
        "new_agent_key": pem(new_key),
        "new_agent_public": signing.public_text(new_key.public_key()),
        "spare_agents": [each.id for each in spare],
        "ids": {
            "device": robot.devices,
            "agent": [robot.id],
            "action": actions,
            "robot_type": ["ur5"],
            **{f"{name}.robot_type": ["ur5_gripper"] for name in ("get_task", "list_tasks", "list_trials")},
            "publish_trials.robot_type": ["ur5_gripper"],
            "task": ["red_cube_in_green_tray"],
            "name": ["mine", "wave"],
            "stream": [each["name"] for each in streams],
            "fault": [each["id"] for each in faults],
            "request_id": [request],
            "space": [robot.space],
        },
    }


NOT_READY = """
[[operations]]
include-name = "GET /api/v1/health/ready"
checks.not_a_server_error.expected-statuses = ["2xx", "4xx", "503"]
"""
"""No worker runs, so the server is not ready."""


def run(host: Host, home: Path, *options: str) -> None:
    site = Site(host.url)
    with PollingRobot(site, "arm", "leg", "head") as robot:
        anna = sign_in(host, site, home, "anna")
        robot.pair(anna)
        robot.connect()
        another = sign_in(host, site, home, "anna")
        world = create_resources(host, site, anna, another, robot)
        (home / "world.json").write_text(json.dumps(world))
        (home / "schemathesis.toml").write_text(NOT_READY)
        done = subprocess.run(
            [
                str(Path(sys.executable).with_name("schemathesis")), "run", f"{host.url}{API}/openapi.json",
                "--checks", ",".join(CHECKS), "--generation-database", "none", "--continue-on-failure",
                "--warnings", "off", "--request-timeout", "60", *options,
            ],
            cwd=home,
            env={
                **os.environ,
                "PYTHONPATH": str(ROOT),
                "SCHEMATHESIS_HOOKS": "tests.api.schemathesis_hooks",
                "TELESCOPE_WORLD": str(home / "world.json"),
            },
            capture_output=True,
            text=True,
            check=False,
        )  # fmt: skip
    site.close()
    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-5_000:]


@pytest.mark.timeout(300)
def test_responses_match_the_document(host: Host, home: Path) -> None:
    run(host, home, "--phases", "examples,coverage,fuzzing", "--max-examples", "4", "--seed", "1")


@pytest.mark.long
@pytest.mark.timeout(3_600)
def test_a_thousand_responses_of_each_operation_match_the_document(host: Host, home: Path) -> None:
    run(host, home, "--max-examples", "1000")
