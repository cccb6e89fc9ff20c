"""The gaze solver turns the head towards a point."""

import math

import msgspec
import pytest

from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import gaze
from tests.unit.device_agent.runtime.actions.robot_api_fixture import Head, able_type


@pytest.mark.parametrize("point", [(1.0, 1.0, 1.0), (2.0, -1.0, 0.2), (0.3, 0.1, 1.8), (-0.5, 0.8, 1.0)])
def test_gaze_reaches_the_point(point: tuple[float, float, float]) -> None:
    found = gaze.solve_gaze(able_type(), Head(), (0.1, -0.1), point)
    left, up = math.atan2(point[1], point[0]), math.atan2(point[2] - 1, math.hypot(point[0], point[1]))
    assert found["shoulder"] == pytest.approx(left, abs=5e-3)
    assert found["elbow"] == pytest.approx(up, abs=5e-3)


def test_gaze_out_of_reach_is_rejected() -> None:
    kind = able_type()
    narrow = tuple(msgspec.structs.replace(joint, lower_rad=-0.2, upper_rad=0.2) for joint in kind.joints)
    with pytest.raises(Refused, match="shoulder, elbow cannot turn far enough"):
        gaze.solve_gaze(msgspec.structs.replace(kind, joints=narrow), Head(), (0.0, 0.0), (0.0, 1.0, 1.0))
