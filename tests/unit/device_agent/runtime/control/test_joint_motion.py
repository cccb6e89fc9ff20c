"""Joint motion: special cases of the generator."""

import msgspec
import pytest

from device_agent.runtime.control.joint_motion import JointMotion
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory
from device_agent.runtime.planning.trajectory import Trajectory
from tests.fakes.drivers import robot_type
from tests.fakes.head_driver import head


def way_to(yaw: float) -> Trajectory:
    score = BehaviourTrajectory(head(), (0.0,) * 4)
    score._add_motion(0, 0.0, 2.0, yaw)
    score._end_s = 2.0
    return score.trajectory()


def test_a_trajectory_that_starts_elsewhere_is_not_followed() -> None:
    motion, one, other = JointMotion(head()), way_to(1.0), way_to(-1.0)
    for _ in range(50):
        motion.follow_trajectory(one, share=1.0)
        motion.propose()
        motion.update()
    assert motion.fastest_rad_s > 0.1
    for _ in range(50):
        motion.follow_trajectory(other, share=1.0)
        motion.update()
    assert not motion.moving
    assert 0.4 < motion.position_rad[0] < 0.7, "it came to rest on the way that it was on"


def test_a_device_without_joints_needs_no_plan() -> None:
    motion = JointMotion(
        msgspec.structs.replace(head(), joints=(), mimic_joints=(), position_dependent_limits=(), home_rad={})
    )
    assert motion.propose() == [[], []]
    assert motion.update() == []
    assert motion.reached
    assert motion.fastest_rad_s == pytest.approx(0.0)


def test_two_parts_of_a_period_brake_as_much_as_a_whole_one() -> None:
    for ridden in (False, True):
        ends = []
        for parts in ((None,), (0.25, 0.75)):
            motion = JointMotion(head())
            way, period_s = way_to(1.0), motion._period_s
            for _ in range(45 if ridden else 15):
                if ridden:
                    motion.follow_trajectory(way, share=1.0)
                else:
                    motion.follow(way.position_rad[-1].tolist())
                motion.propose()
                motion.update()
            before_rad, before_rad_s = motion.position_rad[0], motion.velocity_rad_s[0]
            motion.brake()
            for part in parts:
                motion.update(part and part * period_s)
            ends.append((motion.position_rad[0], motion.velocity_rad_s[0]))
        assert ends[0] == pytest.approx(ends[1], abs=0.02)
        assert ends[0] != pytest.approx((before_rad, before_rad_s), abs=0.02)
        assert abs(ends[0][1]) > 0.1
        assert motion._generator.delta_time == pytest.approx(motion._period_s)


def test_a_short_brake_does_not_reverse_the_motion() -> None:
    for periods in range(1, 12):
        motion = JointMotion(robot_type())
        motion.start_at([3.0, 3.0])
        for braking in [False] * periods + [True] + [False] * 30:
            if braking:
                motion.brake()
            else:
                motion.follow([0.0, 0.0])
            motion.update()
            assert max(motion.position_rad) <= 3.0 + 1e-9, "out of its range"
        assert motion.velocity_rad_s[0] < -0.1, "it goes on"
