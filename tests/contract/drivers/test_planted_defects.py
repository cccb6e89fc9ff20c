"""Each planted defect of a driver fails the contract suite, in the test that is meant for it."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from tests.contract.drivers import planted_defects
from tests.harness.paths import ROOT

DEFECTS = {name: each for name, each in vars(planted_defects).items() if name.startswith("Test")}


@pytest.fixture(scope="module")
def failures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Class → tests that failed, of one run of all suites."""
    report = tmp_path_factory.mktemp("planted") / "report.xml"
    selected = " or ".join(f"({name} and {each.caught_by.partition('[')[0]})" for name, each in DEFECTS.items())
    program = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", f"--junitxml={report}", "-k", selected]
    subprocess.run([*program, planted_defects.__file__], cwd=ROOT, check=False, capture_output=True, timeout=500)
    failed: dict[str, set[str]] = {}
    for case in ET.parse(Path(report)).iter("testcase"):  # noqa: S314 (written by pytest)
        if case.find("failure") is not None:
            failed.setdefault(case.attrib["classname"].rpartition(".")[2], set()).add(case.attrib["name"])
    return failed


@pytest.mark.parametrize("name", DEFECTS)
def test_a_planted_defect_fails_the_suite(failures: dict[str, set[str]], name: str) -> None:
    assert DEFECTS[name].caught_by in failures.get(name, set())
