"""Diagnostics of manifests are validated."""

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROOT

UR5 = ROOT / "robots" / "ur5" / "robot.toml"


def given(lines: str) -> str:
    return f'{UR5.read_text(encoding="utf-8")}\n[[diagnostics]]\nfields = "x"\nlabel = "X"\n{lines}\n'


def test_ascending_limits_are_accepted() -> None:
    known = robot_type.parse(given("low = -1\nwarning_high = 2\nhigh = 3\nchecks = ['level']"))
    last = known.diagnostics[-1]
    assert (last.low, last.warning_low, last.warning_high, last.high) == (-1.0, None, 2.0, 3.0)
    assert (last.stream, last.checks) == ("health", ("level",))


@pytest.mark.parametrize(
    "lines",
    [
        "low = 2\nhigh = 1",
        "warning_high = 5\nhigh = 4",
        "high = nan",
        "high = inf",
        "change = 0",
        "horizon_s = 1",
        "checks = ['why']",
        "limit = 3",
        "fields = ''",
    ],
)
def test_contradictions_are_rejected(lines: str) -> None:
    with pytest.raises(ProtocolError):
        robot_type.parse(given(lines))


def test_diagnostics_of_the_ur5_have_advice() -> None:
    known = robot_type.load(UR5.parent)
    assert {one.stream for one in known.diagnostics} == {"health", "joints"}
    assert all(one.advice for one in known.diagnostics)
