"""An installation on this machine, and its administration commands."""

from collections.abc import Callable
from pathlib import Path

import pytest

from function_app.__main__ import main
from tests.harness.cloud.cloud import Cloud
from tests.harness.cloud.cloud import settings as cloud_settings

Run = Callable[..., tuple[int, str]]
SOURCE = "robot.home()"


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an installation with an account, a script and an audit log."""
    home = tmp_path / "home"
    home.mkdir(mode=0o700)
    monkeypatch.setenv("TELESCOPE_HOME", str(home))
    with Cloud(cloud_settings(home)) as cloud:
        anna = cloud.sign_in("anna")
        assert anna.put("/robot-types/ur5/movements/mine", {"source": SOURCE}).status_code in {200, 201}
        cloud.run(cloud.functions.audit_log.anchor(anna.account))
    for name in ("agents", "logs", "mosquitto"):
        (home / name).mkdir()
        (home / name / "file").write_text(name)
    return home


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command; returns its exit code and its output with the error message."""

    def command(*arguments: str | Path) -> tuple[int, str]:
        code = main([str(each) for each in arguments])
        captured = capsys.readouterr()
        return code, captured.out + "".join(
            line for line in captured.err.splitlines(keepends=True) if line.startswith("telescope-server: ")
        )

    return command
