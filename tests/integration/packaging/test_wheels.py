"""The two distributions: their contents, their commands, and equal versions."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.harness.paths import ROOT

DISTRIBUTIONS = {"telescope-agent": ROOT / "infra" / "packaging" / "telescope-agent", "telescope-server": ROOT}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folder of each distribution, installed from its wheel without dependencies."""
    folders = {}
    for name, source in DISTRIBUTIONS.items():
        folders[name] = tmp_path_factory.mktemp(name)
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"]
        options = ["--no-deps", "--no-build-isolation", "--target", str(folders[name]), str(source)]
        done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    return folders


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_the_command_prints_its_help_outside_the_repository(
    installed: dict[str, Path], name: str, tmp_path: Path
) -> None:
    done = subprocess.run(
        [installed[name] / "bin" / name, "--help"],
        cwd=tmp_path,
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(installed[name])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage:")


def test_each_wheel_contains_the_robots_and_its_own_side_only(installed: dict[str, Path]) -> None:
    for folder in installed.values():
        assert (folder / "device_agent" / "robots" / "ur5" / "robot.toml").is_file()
    assert not (installed["telescope-agent"] / "function_app").exists()
    assert not (installed["telescope-server"] / "device_agent" / "runtime").exists()


def test_both_distributions_have_the_same_version() -> None:
    files = [source / "pyproject.toml" for source in DISTRIBUTIONS.values()]
    projects = [tomllib.loads(file.read_text(encoding="utf-8"))["project"] for file in files]
    assert {project["name"] for project in projects} == set(DISTRIBUTIONS)
    assert len({project["version"] for project in projects}) == 1
