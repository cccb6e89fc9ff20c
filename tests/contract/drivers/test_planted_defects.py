"""Each planted defect of a driver fails the contract suite, in the test that is meant for it."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from tests.contract.drivers import planted_defects
from tests.harness.paths import ROOT

DEFECTS = {name: each for name, each in vars(planted_defects).items() if name.startswith("Test")}


@pytest.mark.parametrize("name", DEFECTS)
def test_a_planted_defect_fails_the_suite(name: str, tmp_path: Path) -> None:
    caught_by = DEFECTS[name].caught_by
    report = tmp_path / "report.xml"
    program = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", f"--junitxml={report}"]
    selected = f"{planted_defects.__file__}::{name}::{caught_by}"
    subprocess.run([*program, selected], cwd=ROOT, check=False, capture_output=True, timeout=300)
    (case,) = ET.parse(report).iter("testcase")  # noqa: S314 (written by pytest)
    assert case.attrib["name"] == caught_by
    assert case.find("failure") is not None
