"""Fusion of odometry and the room's positions."""

import math
from dataclasses import astuple

import pytest

from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.localization import Pose2D, PoseEstimator
from device_agent.runtime.readings import Reading
from tests.harness.agent.controller_fixture import refuses


def test_room_positions_correct_or_replace_the_odometry() -> None:
    estimator = PoseEstimator()
    odometry = Reading({"x_m": 1.0, "y_m": 0.0, "yaw_rad": 0.5}, 0.02)
    observed = Reading({"x_m.qbo": 1.2, "y_m.qbo": 0.1, "age_s.qbo": 0.2}, 0.1)
    assert estimator.estimate("qbo", odometry, None) == Pose2D(1.0, 0.0, 0.5)
    corrected = pytest.approx((1.2, 0.1, 0.5))
    assert astuple(estimator.estimate("qbo", odometry, observed)) == corrected
    assert astuple(estimator.estimate("qbo", odometry, None)) == corrected, "the correction remains"
    observed = Reading({"x_m.nao": 1.2, "y_m.nao": 0.1, "yaw_rad.nao": 0.3}, 0.1)
    assert PoseEstimator().estimate("nao", None, observed) == Pose2D(1.2, 0.1, 0.3)


def wheels(x_m: float) -> Reading:
    return Reading({"x_m": x_m, "y_m": 0.0, "yaw_rad": 0.0}, 0.02)


def seen(x_m: float, *, age_s: float = 0.1) -> Reading:
    return Reading({"x_m.qbo": x_m, "y_m.qbo": 0.0, "age_s.qbo": age_s}, 0.1)


@pytest.mark.parametrize("drift", [0.02, -0.08])
def test_slow_drift_of_the_odometry_is_corrected(drift: float) -> None:
    estimator = PoseEstimator()
    for step in range(50):
        pose = estimator.estimate("qbo", wheels(step * 0.1), seen(step * 0.1 * (1 + drift)))
    assert pose.x_m == pytest.approx(4.9 * (1 + drift), abs=0.1)


@pytest.mark.parametrize(
    "motions",
    [
        [(step * 0.024, 0.0) for step in range(20)],  # the wheels slip
        [(0.0, 0.0), (0.0, 0.3)],  # perception confuses it with another object
        [(0.0, 0.0), (0.0, 0.0), None, (0.0, 0.3)],  # the same between two motions
    ],
)
def test_odometry_and_room_that_contradict_each_other_end_the_motion(motions: list[tuple[float, float] | None]) -> None:
    estimator = PoseEstimator()
    with refuses("position_conflict"):
        for motion in motions:
            if motion is None:
                estimator.start(0.24)
            else:
                estimator.estimate("qbo", wheels(motion[0]), seen(motion[1]))
    x_m, y_m = motions[-1] or (0.0, 0.0)
    estimator.start(0.24)
    assert estimator.estimate("qbo", wheels(x_m), seen(y_m)).x_m == pytest.approx(y_m), "a new motion starts anew"


def test_drift_while_a_person_drives_the_robot_does_not_end_the_next_motion() -> None:
    estimator = PoseEstimator()
    estimator.start(0.24)
    estimator.estimate("qbo", wheels(0.0), seen(0.0))
    estimator.start(0.24)
    assert estimator.estimate("qbo", wheels(3.0), seen(2.5)).x_m == pytest.approx(2.5)


def test_the_path_through_a_blind_spot_counts_for_the_drift() -> None:
    estimator = PoseEstimator()
    estimator.start(0.24)
    estimator.estimate("qbo", wheels(0.0), seen(0.0))
    for x_m in [*(step * 0.1 for step in range(16)), *(step * 0.1 for step in range(15, -1, -1))]:
        estimator.estimate("qbo", wheels(x_m), None)
    assert estimator.estimate("qbo", wheels(0.0), seen(0.4)).x_m == pytest.approx(0.04), "3 m there and back"


def test_slip_out_of_view_is_a_conflict_at_the_next_motion() -> None:
    estimator = PoseEstimator()
    estimator.start(0.24)
    estimator.estimate("qbo", wheels(0.0), seen(0.0))
    for step in range(1, 11):
        estimator.estimate("qbo", wheels(step * 0.1), None)
    estimator.start(0.24)
    with refuses("position_conflict"):
        estimator.estimate("qbo", wheels(1.0), seen(0.0))


def test_late_positions_of_a_moving_robot_do_not_contradict_its_odometry() -> None:
    estimator = PoseEstimator()
    estimator.start(1.0)
    for step in range(20):
        estimator.estimate("qbo", wheels(step * 0.1), seen(max(0, step - 6) * 0.1, age_s=0.6))


@pytest.mark.parametrize("lost", [seen(0.0, age_s=16.0), None])
def test_a_robot_that_the_room_has_lost_neither_starts_nor_arrives(lost: Reading | None) -> None:
    estimator = PoseEstimator()
    estimator.estimate("qbo", wheels(0.0), seen(0.0))
    assert estimator.estimate("qbo", wheels(0.5), lost).x_m == 0.5, "it may drive through a blind spot"
    with refuses("no_position"):
        estimator.estimate("qbo", wheels(0.5), lost, confirm=True)
    estimator.start(0.24)
    with refuses("no_position"):
        estimator.estimate("qbo", wheels(0.5), lost)


@pytest.mark.parametrize(
    "observed",
    [
        None,
        Reading({"x_m.nao": 1.2, "y_m.nao": 0.1}, 0.1),
        Reading({"x_m.nao": 1.2, "y_m.nao": 0.1, "yaw_rad.nao": 0.3}, 1.5),
        Reading({"x_m.nao": 1.2, "y_m.nao": 0.1, "yaw_rad.nao": 0.3, "age_s.nao": 2.0}, 0.1),
        Reading({"x_m.nao": math.nan, "y_m.nao": 0.1, "yaw_rad.nao": 0.3}, 0.1),
        Reading({"x_m.qbo": 1.2, "y_m.qbo": 0.1, "yaw_rad.qbo": 0.3}, 0.1),
    ],
)
def test_a_robot_without_a_position_does_not_drive(observed: Reading | None) -> None:
    with pytest.raises(Refused, match="the position of the robot is unknown"):
        PoseEstimator().estimate("nao", None, observed)
