"""Limits in a manifest that nothing could be controlled with are refused, with the field's name."""

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests.robot_type import Base, Workspace, parse
from tests.harness.paths import ROOT

UR5 = (ROOT / "robots" / "ur5" / "robot.toml").read_text(encoding="utf-8")
BASE = """
[base]
max_linear_m_s = 0.5
max_angular_rad_s = 1.0
max_linear_acceleration_m_s2 = 1.0
max_angular_acceleration_rad_s2 = 2.0
braking_linear_m_s2 = 2.0
braking_angular_rad_s2 = 4.0
"""


def test_limits_are_read() -> None:
    kind = parse(UR5 + BASE)
    assert kind.margin_m == 0.02
    assert isinstance(kind.workspace, Workspace)
    assert kind.workspace.lower_m == (-1.1, -1.1, 0.0)
    assert isinstance(kind.base, Base)
    assert not kind.base.sideways


@pytest.mark.parametrize(
    ("was", "now", "says"),
    [
        ("period_ms = 8", "period_ms = 8\nmargin_m = -0.1", "margin_m is -0.1"),
        ("period_ms = 8", "period_ms = 8\nmargin_m = nan", "margin_m is nan"),
        ("lower_m = [-1.1, -1.1, 0.0]", "lower_m = [-1.1, -1.1, 2.0]", "lower_m must be below upper_m"),
        ("lower_m = [-1.1, -1.1, 0.0]", "lower_m = [-inf, -1.1, 0.0]", "finite"),
        ("lower_m = [-1.1, -1.1, 0.0]", "lower_m = [-1.1, nan, 0.0]", "lower_m must be below upper_m"),
        ('"wrist_3", "flange"]\n\n', '"wrist_3", "hand"]\n\n', "workspace: no frame 'hand'; there are: shoulder_pan"),
        ('model = "ur5.xml"', 'model = ""', "workspace needs a model"),
        ("max_linear_m_s = 0.5", "max_linear_m_s = 0", "max_linear_m_s of base is 0"),
        ("braking_linear_m_s2 = 2.0", "braking_linear_m_s2 = inf", "braking_linear_m_s2 of base is inf"),
        ("max_angular_rad_s = 1.0", "", "max_angular_rad_s"),
    ],
)
def test_limits_that_are_none_are_refused(was: str, now: str, says: str) -> None:
    text = UR5 + BASE
    assert was in text
    with pytest.raises(ProtocolError, match=says):
        parse(text.replace(was, now))


@pytest.mark.parametrize(
    ("cameras", "says"),
    [
        ('[{ name = "eyes", rate_hz = 30.0 }]', "camera 'eyes': rate_hz is 30; the limit is 10"),
        ('[{ name = "eyes", rate_hz = 0.0 }]', "rate_hz of camera 'eyes' is 0"),
        ('[{ name = "eyes", rate_hz = 1.0 }, { name = "eyes", rate_hz = 1.0 }]', "two cameras"),
    ],
)
def test_cameras_take_a_moderate_number_of_pictures(cameras: str, says: str) -> None:
    with pytest.raises(ProtocolError, match=says):
        parse(UR5.replace("period_ms = 8", f"period_ms = 8\ncameras = {cameras}"))
