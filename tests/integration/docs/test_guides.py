"""The commands and files of the guides, executed from top to bottom."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.harness.cloud.cloud_processes import CloudProcesses
from tests.harness.documents import follow
from tests.harness.network.brokers import BrokerKind
from tests.harness.paths import ROOT

GUIDES = ROOT / "docs" / "guides"


@pytest.fixture
def processes(start_processes: Callable[[BrokerKind], CloudProcesses]) -> CloudProcesses:
    return start_processes("amqtt")


@pytest.mark.timeout(300)
def test_add_a_robot_creates_a_robot_type_and_a_driver(processes: CloudProcesses, tmp_path: Path) -> None:
    token = {"TELESCOPE_TOKEN": processes.anna.token}
    output = follow(GUIDES / "add-a-robot.md", tmp_path, token, processes.url)
    assert "type    lever: A lever" in output
    assert "driver  lever" in output
    assert "claim code" in output.lower()
    assert (tmp_path / "lever.png").read_bytes()[:4] == b"\x89PNG"
    assert len(re.findall(r"^\d+ passed", output, re.MULTILINE)) == 2, output
    assert "deselected" in output
    assert processes.anna.request("GET", "/robot-types/lever").json()["label"] == "A lever"


@pytest.mark.parametrize(
    ("page", "expected"),
    [("install-an-agent", "ur5"), ("operate-a-site", "#sign-in="), ("security-on-a-site", "site.example")],
)
def test_administration_commands_run_as_written(page: str, expected: str, tmp_path: Path) -> None:
    assert expected in follow(GUIDES / f"{page}.md", tmp_path, {})
