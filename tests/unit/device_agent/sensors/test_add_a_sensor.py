"""The files of ``docs/guides/add-a-sensor.md`` work as they are."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.paths import ROOT

PAGE = (Path(ROOT) / "docs" / "guides" / "add-a-sensor.md").read_text()
FILES = dict(re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", PAGE, re.DOTALL))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, content in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return tmp_path


def run(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    paths = os.pathsep.join((str(folder), str(ROOT)))
    environment = os.environ | {"PYTHONPATH": paths, "TELESCOPE_ROBOTS_PATH": str(folder)}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_the_guide_has_four_files() -> None:
    assert len(FILES) == 4


def test_the_guides_driver_passes_the_contract(folder: Path) -> None:
    done = run(folder, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_weather_station.py")
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\b9 passed", done.stdout), done.stdout


def test_the_agent_lists_room_and_driver(folder: Path) -> None:
    done = run(folder, "-m", "device_agent", "devices", "--home", str(folder / "missing"))
    assert "room    roof: Roof" in done.stdout, done.stdout + done.stderr
    assert "sensor  weather_station" in done.stdout
