"""Motion by itself: what it does when asked for what cannot be."""

import msgspec
import pytest

from device_agent.runtime.motion import Motion
from device_agent.runtime.score import Score
from device_agent.runtime.way import Way
from tests.support.head import head


def way_to(yaw: float) -> Way:
    score = Score(head(), (0.0,) * 4)
    score._reach(0, 0.0, 2.0, yaw)
    score._end_s = 2.0
    return score.way()


def test_a_way_that_begins_elsewhere_is_not_taken() -> None:
    motion, one, other = Motion(head()), way_to(1.0), way_to(-1.0)
    for _ in range(50):
        motion.ride(one, share=1.0)
        motion.propose()
        motion.update()
    assert motion.fastest_rad_s > 0.1
    for _ in range(50):
        motion.ride(other, share=1.0)
        motion.update()
    assert not motion.moving
    assert 0.4 < motion.position_rad[0] < 0.7, "it came to rest on the way that it was on"


def test_without_joints_there_is_nothing_to_plan() -> None:
    motion = Motion(msgspec.structs.replace(head(), joints=(), mirrors=(), narrowing=(), home_rad={}))
    assert motion.propose() == [[], []]
    assert motion.update() == []
    assert motion.reached
    assert motion.fastest_rad_s == pytest.approx(0.0)
