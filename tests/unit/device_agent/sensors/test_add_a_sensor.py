"""``docs/guides/add-a-sensor.md``: its files are found by the agent and pass the contract suite."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.documents import blocks
from tests.harness.paths import ROOT

pytestmark = pytest.mark.slow
FILES = [block for block in blocks(ROOT / "docs" / "guides" / "add-a-sensor.md") if block.use == "file"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    assert len(FILES) == 4
    for each in FILES:
        path = tmp_path / each.argument
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(each.text)
    return tmp_path


def run(folder: Path, *arguments: str) -> str:
    paths = os.pathsep.join((str(folder), str(ROOT)))
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": paths, "TELESCOPE_ROBOTS_PATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_driver_passes_the_contract_suite(folder: Path) -> None:
    output = run(folder, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_weather_station.py")
    assert re.search(r"\b8 passed", output), output


def test_the_agent_finds_the_room_and_the_driver(folder: Path) -> None:
    output = run(folder, "-m", "device_agent", "devices", "--home", str(folder / "agent"))
    assert "room    roof: Roof" in output
    assert "sensor  weather_station" in output
