"""The program for a NAO has the syntax of its Python."""

import subprocess

import pytest

from tests.harness.hosts.host import interpreter
from tests.harness.paths import ROOT

PROGRAM = ROOT / "examples" / "nao" / "telescope_watchdog.py"


@pytest.mark.parametrize("version", ["2.7", "3.13"])
def test_it_compiles_with_the_python_of_a_robot(version: str) -> None:
    check = [interpreter(version), "-c", "import sys; compile(sys.stdin.read(), 'watchdog', 'exec')"]
    done = subprocess.run(check, input=PROGRAM.read_text(), capture_output=True, text=True, check=False)
    assert done.stderr == ""
