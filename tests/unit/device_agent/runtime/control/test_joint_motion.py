"""Joint motion: special cases of the generator."""

import msgspec
import pytest

from device_agent.protocol.manifests.capabilities import Keyframe
from device_agent.runtime.control.joint_motion import JointMotion
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory
from device_agent.runtime.planning.trajectory import Trajectory
from tests.fakes.drivers import robot_type
from tests.fakes.head_driver import PERIOD_S, head


def turn_to(yaw: float) -> Trajectory:
    behaviour = BehaviourTrajectory(head(), (0.0,) * 4)
    behaviour.add_keyframes([Keyframe(time_s=2.0, position_rad={"yaw": yaw})], {})
    return behaviour.trajectory()


def follow(motion: JointMotion, trajectory: Trajectory, periods: int) -> None:
    for _ in range(periods):
        motion.follow_trajectory(trajectory, share=1.0)
        motion.propose()
        motion.update()


def test_a_trajectory_that_starts_elsewhere_is_not_followed() -> None:
    motion = JointMotion(head())
    follow(motion, turn_to(1.0), 50)
    assert motion.fastest_rad_s > 0.1
    follow(motion, turn_to(-1.0), 50)
    assert not motion.moving
    assert 0.4 < motion.position_rad[0] < 0.7, "the joint rests on its trajectory"


@pytest.mark.parametrize("acceleration", [1.0, 2.0, 4.0, 5.0])
@pytest.mark.parametrize("end", [0.1, 0.0, -0.3])
def test_a_motion_that_only_just_reaches_the_acceleration_limit_is_possible(acceleration: float, end: float) -> None:
    """``ruckig`` itself finds no trajectory for some of these starts, which differ by rounding only."""
    limits = {"max_velocity_rad_s": 2.0, "max_acceleration_rad_s2": acceleration, "max_jerk_rad_s3": 5 * acceleration}
    kind = robot_type()
    kind = msgspec.structs.replace(
        kind, joints=tuple(msgspec.structs.replace(joint, **limits) for joint in kind.joints)
    )
    shortest_rad = 2 * acceleration**3 / limits["max_jerk_rad_s3"] ** 2
    for rounding in (0.0, 5e-17, 1.1e-16, 2.2e-16, -5.5e-17, -2.2e-16):
        motion = JointMotion(kind)
        motion.start_at([end + shortest_rad + rounding] * len(kind.joints))
        for _ in range(400):
            motion.follow([end] * len(kind.joints))
            motion.update()
        assert motion.position_rad == pytest.approx([end] * len(kind.joints))


def test_a_device_without_joints_needs_no_plan() -> None:
    motion = JointMotion(msgspec.structs.replace(robot_type(), joints=(), home_rad={}))
    assert motion.propose() == [[], []]
    assert motion.update() == []
    assert motion.reached
    assert motion.fastest_rad_s == pytest.approx(0.0)


@pytest.mark.parametrize("on_trajectory", [False, True])
def test_two_parts_of_a_period_brake_as_much_as_a_whole_one(on_trajectory: bool) -> None:
    ends = []
    for parts in ((None,), (0.25, 0.75)):
        motion = JointMotion(head())
        if on_trajectory:
            follow(motion, turn_to(1.0), 45)
        else:
            for _ in range(15):
                motion.follow([1.0, 0.0, 0.0, 0.0])
                motion.update()
        before = motion.position_rad[0], motion.velocity_rad_s[0]
        motion.brake()
        for part in parts:
            motion.update(part and part * PERIOD_S)
        ends.append((motion.position_rad[0], motion.velocity_rad_s[0]))
    assert ends[0] == pytest.approx(ends[1], abs=0.02)
    assert ends[0] != pytest.approx(before, abs=0.02)
    assert abs(ends[0][1]) > 0.1
    assert motion._generator.delta_time == pytest.approx(PERIOD_S)


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
        assert motion.velocity_rad_s[0] < -0.1, "the motion continues"
