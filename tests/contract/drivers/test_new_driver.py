"""``new-driver`` creates packages whose own tests, the driver contract, pass."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from device_agent.__main__ import main
from tests.harness.paths import ROOT


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )


@pytest.mark.parametrize(("kind", "robot_type"), [("arm", "ur5"), ("base", "qbo")])
def test_the_tests_of_a_new_package_pass(tmp_path: Path, kind: str, robot_type: str) -> None:
    assert main(["new-driver", "my-robot", "--kind", kind, "--into", str(tmp_path)]) == 0
    folder = tmp_path / "telescope-my-robot"
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    base = {"telescope_my_robot/base_driver.py"} if kind == "base" else set()
    assert files == base | {
        "README.md",
        "pyproject.toml",
        "telescope_my_robot/__init__.py",
        "telescope_my_robot/connection.py",
        "telescope_my_robot/driver.py",
        "tests/peer.py",
        "tests/test_driver.py",
    }
    text = "\n".join((folder / file).read_text() for file in files)
    assert "emplate" not in text
    assert f'type = "{robot_type}"' in text
    done = run(folder, "-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider")
    assert done.returncode == 0, done.stdout
    assert "skipped" not in done.stdout
    done = run(folder, "-c", "import telescope_my_robot as package; package.create(None, None, {}, '')")
    assert "option 'address' of driver 'my-robot' must be host:port" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["My_Robot"], "'My_Robot' is not a driver name"),
        (["mujoco"], "there is a driver 'mujoco' already"),
        (["mine", "--type", "qbo"], "robot type 'qbo' has a base"),
        (["mine", "--kind", "base", "--type", "ur5"], "robot type 'ur5' has no base"),
        (["mine", "--type", "unknown"], "no robot type 'unknown'"),
        (["existing"], "exists already"),
    ],
)
def test_wrong_requests_create_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    (tmp_path / "telescope-existing").mkdir()
    assert main(["new-driver", *arguments, "--into", str(tmp_path)]) == 1
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == ["telescope-existing"]
