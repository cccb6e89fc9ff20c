"""Behaviour trajectories: keyframes, speech and visemes."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device_agent.protocol.manifests.capabilities import Keyframe
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.planning import visemes
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory, SpokenLine
from device_agent.runtime.planning.trajectory import Trajectory
from tests.fakes.head_driver import BENT, RANGES, head

HOME = (0.0, 0.0, 0.0, 0.0)
RANGE = dict(zip(("yaw", "pitch", "left"), RANGES, strict=False))


def talking() -> RobotType:
    """A head whose pitch is a jaw."""
    visemes = {"aa": {"pitch": -0.5}, "PP": {"pitch": 0.0}, "oh": {"pitch": -0.3, "yaw": 0.2}}
    return msgspec.structs.replace(head(), visemes=visemes)


def at(trajectory: Trajectory, time_s: float) -> list[float]:
    position: list[float] = trajectory.at(time_s)[0].tolist()
    return position


def frame(time_s: float, say: str = "", **position_rad: float) -> Keyframe:
    return Keyframe(time_s=time_s, position_rad=position_rad, say=say)


def check_limits(trajectory: Trajectory, kind: RobotType) -> None:
    """Check velocities, and acceleration and jerk of joints without couplings."""
    for index, joint in enumerate(kind.joints):
        assert np.abs(trajectory.velocity_rad_s[:, index]).max() <= joint.max_velocity_rad_s * 1.001
        if joint.name in {"yaw", "left"}:
            assert np.abs(trajectory.acceleration_rad_s2[:, index]).max() <= joint.max_acceleration_rad_s2 * 1.001
            jerk = np.diff(trajectory.acceleration_rad_s2[:, index]) / trajectory.step_s
            assert np.abs(jerk).max() <= joint.max_jerk_rad_s3 * 1.001


def test_joints_reach_keyframes_in_time() -> None:
    behaviour = BehaviourTrajectory(head(), HOME)
    assert behaviour.add_keyframes([frame(1.0, yaw=0.5), frame(2.0, left=-0.4), frame(3.0, yaw=0.0)], {}) == []
    trajectory = behaviour.trajectory()
    assert trajectory.duration_s == pytest.approx(3.0, abs=0.03)
    assert at(trajectory, 1.0) == pytest.approx([0.5, 0.0, 0.0, 0.0], abs=1e-9)
    assert at(trajectory, 2.0) == pytest.approx([0.5, 0.0, -0.4, 0.2], abs=1e-9)
    assert at(trajectory, 1.5)[2] == pytest.approx(-0.2, abs=1e-6), "it starts at the previous keyframe"
    assert at(trajectory, 3.0) == pytest.approx([0.0, 0.0, -0.4, 0.2], abs=1e-9)
    assert np.abs(trajectory.velocity_rad_s[[0, -1]]).max() < 1e-9
    check_limits(trajectory, head())


def test_unreachable_times_delay_all_later_keyframes() -> None:
    behaviour = BehaviourTrajectory(head(), HOME)
    behaviour.add_keyframes([frame(0.1, yaw=2.0), frame(0.2, yaw=-2.0)], {})
    trajectory = behaviour.trajectory()
    check_limits(trajectory, head())
    assert trajectory.duration_s > 2.0
    turn = int(np.argmax(trajectory.position_rad[:, 0]))
    assert trajectory.position_rad[turn, 0] == pytest.approx(2.0, abs=0.02)
    assert at(trajectory, trajectory.duration_s)[0] == pytest.approx(-2.0)


def test_lines_start_with_the_motion_to_their_keyframe() -> None:
    behaviour = BehaviourTrajectory(head(), HOME)
    frames = [frame(1.0, yaw=0.2), frame(2.0, say="there"), frame(2.5, yaw=0.0, say="and back")]
    lines = behaviour.add_keyframes(frames, {"there": 0.5, "and back": 3.0})
    assert lines == [SpokenLine(1.0, "there", 0.5), SpokenLine(2.0, "and back", 3.0)]
    assert behaviour.trajectory().duration_s >= 5.0, "it lasts until the end of the speech"
    resting = BehaviourTrajectory(head(), (0.3, 0.0, 0.0, 0.0)).trajectory()
    assert resting.duration_s > 0
    assert at(resting, 0.0) == at(resting, 9.0) == [0.3, 0.0, 0.0, 0.0]


@settings(max_examples=40)
@given(
    steps=st.lists(
        st.tuples(
            st.floats(0, 1.5),
            st.dictionaries(st.sampled_from(list(RANGE)), st.floats(0, 1), max_size=3),
            st.sampled_from(("", "", "hello there")),
        ),
        min_size=1,
        max_size=6,
    ),
    table=st.sampled_from((None, BENT)),
)
def test_a_trajectory_stays_within_ranges_and_limits(
    steps: list[tuple[float, dict[str, float], str]], table: tuple[tuple[float, float, float], ...] | None
) -> None:
    kind = talking() if table is None else head(table)
    time_s, frames = 0.0, []
    for pause_s, shares, say in steps:
        time_s += pause_s
        positions = {name: low + share * (high - low) for name, share in shares.items() for low, high in [RANGE[name]]}
        frames.append(frame(time_s, say, **positions))
    behaviour = BehaviourTrajectory(kind, HOME)
    behaviour.add_keyframes(frames, {"hello there": 1.0})
    trajectory = behaviour.trajectory()
    MotionLimits(kind, None).check_trajectory(trajectory.position_rad)
    assert np.isfinite(trajectory.velocity_rad_s).all()
    if table is None:
        check_limits(trajectory, kind)


def test_the_mouth_opens_for_vowels_and_closes_at_the_end() -> None:
    behaviour = BehaviourTrajectory(talking(), (0.0, -0.1, 0.0, 0.0))
    behaviour.add_speech(SpokenLine(0.0, "mama", 3.0))
    trajectory = behaviour.trajectory()
    assert trajectory.position_rad[:, 1].min() < -0.25
    assert at(trajectory, trajectory.duration_s)[1] == pytest.approx(-0.1)
    check_limits(trajectory, talking())


def test_mouth_shapes_start_from_and_return_to_the_keyframes() -> None:
    behaviour = BehaviourTrajectory(talking(), HOME)
    behaviour.add_keyframes([frame(0.5, pitch=-0.2), frame(1.0, say="baba"), frame(4.0, pitch=0.1)], {"baba": 1.0})
    trajectory = behaviour.trajectory()
    assert at(trajectory, 0.5)[1] == pytest.approx(-0.2)
    assert at(trajectory, 2.5)[1] == pytest.approx(-0.2, abs=0.15), "closed, or moving to the next keyframe"
    assert at(trajectory, trajectory.duration_s)[1] == pytest.approx(0.1)


def test_overlapping_lines_wait_for_the_mouth() -> None:
    behaviour = BehaviourTrajectory(talking(), HOME)
    behaviour.add_speech(SpokenLine(0.0, "mama", 3.0))
    behaviour.add_speech(SpokenLine(2.9, "mama", 3.0))
    trajectory = behaviour.trajectory()
    check_limits(trajectory, talking())
    assert trajectory.duration_s == pytest.approx(5.9 + 0.2, abs=0.03)
    assert at(trajectory, trajectory.duration_s)[1] == pytest.approx(0.0)


def test_letters_map_to_visemes_in_order_and_missing_ones_are_substituted() -> None:
    shapes = visemes.visemes_of("Path: súm!", 2.0, ("sil", "PP", "aa", "TH", "SS"))
    assert [shape for _, shape in shapes] == ["PP", "aa", "TH", "sil", "sil", "SS", "aa", "PP", "sil"]
    assert all(early < late for (early, _), (late, _) in pairwise(shapes))
    assert 0 < shapes[0][0] < shapes[-1][0] < 2.0
    for text, substitutes in (("o", ["aa"]), ("m", []), ("…", [])):
        assert [shape for _, shape in visemes.visemes_of(text, 1.0, ("aa",))] == substitutes


def test_the_duration_of_silent_speech_is_estimated() -> None:
    assert visemes.estimate_duration_s("a" * 140) == pytest.approx(10.0)
    assert visemes.estimate_duration_s("a") > 0.1
