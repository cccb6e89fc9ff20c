"""``telescope-server`` commands in the test's process."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import pytest

from function_app.__main__ import main


class Ended(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


RunCommand = Callable[..., Ended]


def command_runner(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RunCommand:
    """Runs a command with its arguments; keywords and a mapping are environment variables."""

    def run(*arguments: str, environment: Mapping[str, str] | None = None, **more: str) -> Ended:
        with monkeypatch.context() as patch:
            for name, value in {**(environment or {}), **more}.items():
                patch.setenv(name, value)
            code = main(arguments)
        return Ended(code, *capsys.readouterr())

    return run
