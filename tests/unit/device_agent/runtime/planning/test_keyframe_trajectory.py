"""Keyframe trajectories: times, limits and agreement with the preview."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device_agent.ports.script_calls import Play, PlayKeyframe
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.keyframe_trajectory import KeyframeTrajectory
from device_agent.runtime.planning.trajectory import Trajectory
from tests.fakes.head_driver import RANGES, head

START = (0.0, 0.0, 0.0, 0.0)
SHARED = Path(__file__).with_name("timelines.json")
"""Movements and their expected trajectories, shared with ``web/tests/features/keyframes/timeline-layout.test.ts``."""


def frame(time_s: float, **position_rad: float) -> PlayKeyframe:
    return PlayKeyframe(time_s=time_s, position_rad=position_rad)


def timeline(*keyframes: PlayKeyframe, speed: float = 1.0) -> KeyframeTrajectory:
    return KeyframeTrajectory(head(), START, Play(keyframes=keyframes, speed=speed))


def at(trajectory: Trajectory, time_s: float) -> list[float]:
    position: list[float] = trajectory.at(time_s)[0].tolist()
    return position


def check_limits(trajectory: Trajectory, kind: RobotType, joints: tuple[int, ...]) -> None:
    for index in joints:
        joint = kind.joints[index]
        assert np.abs(trajectory.velocity_rad_s[:, index]).max() <= joint.max_velocity_rad_s * 1.001
        assert np.abs(trajectory.acceleration_rad_s2[:, index]).max() <= joint.max_acceleration_rad_s2 * 1.002
        jerk = np.diff(trajectory.acceleration_rad_s2[:, index]) / trajectory.step_s
        assert np.abs(jerk).max() <= joint.max_jerk_rad_s3 * 1.01


def test_joints_reach_keyframes_in_time_and_pass_through() -> None:
    timed = timeline(frame(1.0, yaw=0.5), frame(2.0, yaw=1.0, left=0.3), frame(4.0, yaw=0.0))
    trajectory = timed.trajectory()
    assert timed.limited == ()
    assert trajectory.duration_s == pytest.approx(4.0, abs=0.021)
    assert at(trajectory, 1.0) == pytest.approx([0.5, 0.0, at(trajectory, 1.0)[2], at(trajectory, 1.0)[3]], abs=1e-6)
    assert at(trajectory, 2.0) == pytest.approx([1.0, 0.0, 0.3, -0.15], abs=1e-6)
    assert at(trajectory, 4.0) == pytest.approx([0.0, 0.0, 0.3, -0.15], abs=1e-6)
    assert trajectory.at(1.0)[1][0] == pytest.approx(0.5, abs=1e-3), "the joint passes the keyframe without stopping"
    assert trajectory.at(2.0)[1][0] == pytest.approx(0.0, abs=1e-3), "the joint reverses"
    assert 0 < at(trajectory, 1.0)[2] < 0.3, "a joint moves through a keyframe that does not name it"
    check_limits(trajectory, head(), (0, 2))


def test_keyframes_that_are_too_early_are_delayed() -> None:
    timed = timeline(frame(0.01, yaw=1.0), frame(1.0, left=0.3))
    trajectory = timed.trajectory()
    assert timed.limited == ("keyframes: later",)
    assert trajectory.duration_s > 1.3
    assert at(trajectory, 9.0) == pytest.approx([1.0, 0.0, 0.3, -0.15], abs=1e-6)
    check_limits(trajectory, head(), (0, 2))


def test_speed_scales_time_within_the_limits() -> None:
    keyframes = (frame(1.0, yaw=0.8), frame(2.0, yaw=0.0))
    assert timeline(*keyframes, speed=0.5).trajectory().duration_s == pytest.approx(4.0, abs=0.021)
    fast = timeline(*keyframes, speed=2.0)
    assert fast.limited
    check_limits(fast.trajectory(), head(), (0,))
    empty = timeline(frame(0.5)).trajectory()
    assert empty.duration_s == pytest.approx(0.5, abs=0.021)
    assert np.ptp(empty.position_rad) == 0


def test_poses_contain_leading_joints_at_each_keyframe() -> None:
    first, second = timeline(frame(1.0, yaw=0.5, right=0.1), frame(2.0, pitch=-0.2)).poses()
    assert first == pytest.approx({"yaw": 0.5, "left": -0.2})
    assert second == pytest.approx({"yaw": 0.5, "left": -0.2, "pitch": -0.2})


@pytest.mark.parametrize(
    ("keyframes", "message"),
    [
        ([frame(0.0, yaw=0.1)], "keyframe 1: time_s is 0.0; times must increase"),
        ([frame(1.0), frame(1.0)], "keyframe 2: time_s is 1.0; times must increase"),
        ([frame(601.0)], "up to 600"),
        ([frame(1.0), frame(2.0, nose=0.1)], "keyframe 2: no joint 'nose'; there are yaw, pitch, left, right"),
        ([frame(1.0, left=0.1, right=0.1)], "keyframe 1: one motor moves right and another joint"),
    ],
)
def test_invalid_keyframes_are_rejected_with_their_number(keyframes: list[PlayKeyframe], message: str) -> None:
    with pytest.raises(Refused) as refused:
        timeline(*keyframes)
    assert message in refused.value.message


def test_after_the_last_iteration_the_whole_trajectory_is_slowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("device_agent.runtime.planning.keyframe_trajectory._ITERATIONS", 1)
    trajectory = timeline(frame(0.1, yaw=1.5), frame(0.12, yaw=1.6), frame(0.5, yaw=-1.0)).trajectory()
    assert np.abs(trajectory.velocity_rad_s).max() <= 4.0


@st.composite
def movements(draw: st.DrawFn) -> list[PlayKeyframe]:
    reached_s, timed = 0.0, []
    for _ in range(draw(st.integers(1, 6))):
        reached_s += draw(st.floats(0.01, 1.5))
        named = draw(st.sets(st.sampled_from((0, 1, 2))))
        places = {("yaw", "pitch", "left")[one]: draw(st.floats(*RANGES[one])) for one in named}
        timed.append(PlayKeyframe(time_s=reached_s, position_rad=places))
    return timed


@pytest.mark.slow
@settings(max_examples=150)
@given(movements())
def test_random_movements_stay_within_limits_and_do_not_overshoot(keyframes: list[PlayKeyframe]) -> None:
    kind = head()
    trajectory = KeyframeTrajectory(kind, START, Play(keyframes=tuple(keyframes), speed=1.0)).trajectory()
    MotionLimits(kind, None).check_trajectory(trajectory.position_rad)
    check_limits(trajectory, kind, (0, 2))
    for index, name in ((0, "yaw"), (2, "left")):
        places = [0.0, *(one.position_rad[name] for one in keyframes if name in one.position_rad)]
        turns = sum((b - a) * (c - b) < 0 for (a, b), (_, c) in pairwise(pairwise(places)))
        way_of = trajectory.position_rad[:, index]
        assert min(places) - 1e-9 <= way_of.min() <= way_of.max() <= max(places) + 1e-9
        steps = np.diff(way_of)
        steps = steps[np.abs(steps) > 1e-9]
        assert np.sum(steps[1:] * steps[:-1] < 0) <= max(turns, 0) + 1


def computed(case: dict[str, Any]) -> dict[str, Any]:
    """Times of a shared movement's keyframes, and joint positions at ten times."""
    keyframes = msgspec.convert(case["keyframes"], tuple[PlayKeyframe, ...])
    timed = KeyframeTrajectory(head(), case["start_rad"], Play(keyframes=keyframes, speed=1.0))
    key_times = timed._key_times()
    times = np.linspace(0, key_times[-1], 10)
    positions = [at(timed.trajectory(), time_s) for time_s in times]
    return {"reached_s": key_times[1:].tolist(), "position_rad": positions}


def test_the_preview_computes_the_same_timeline() -> None:
    cases = json.loads(SHARED.read_text())
    assert cases
    for case in cases:
        actual, expected = computed(case), case["expected"]
        assert actual["reached_s"] == pytest.approx(expected["reached_s"], rel=1e-6), case["name"]
        positions = np.array(expected["position_rad"])
        assert np.array(actual["position_rad"]) == pytest.approx(positions, abs=1e-6), case["name"]


if __name__ == "__main__":
    cases = json.loads(SHARED.read_text())
    SHARED.write_text(json.dumps([case | {"expected": computed(case)} for case in cases], indent=1) + "\n")
