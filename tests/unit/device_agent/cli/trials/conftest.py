"""A robot type whose files a test changes."""

import shutil
from pathlib import Path

import pytest

from device_agent.config.catalogue import ROBOTS_PATH
from tests.harness.paths import ROBOTS
from tests.unit.device_agent.cli.trials.folders import replace


@pytest.fixture
def altered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the UR5 with a gripper, named ``altered``."""
    folder = tmp_path / "altered"
    shutil.copytree(ROBOTS / "ur5_gripper", folder)
    replace(folder / "robot.toml", 'type = "ur5_gripper"', 'type = "altered"')
    monkeypatch.setenv(ROBOTS_PATH, str(tmp_path))
    return folder
