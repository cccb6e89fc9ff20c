"""A machine that is busy: the control loop is called late. A hold takes no longer, and nothing jumps."""

import pytest

from tests.fakes.drivers import PERIOD_S
from tests.harness.agent.controller_fixture import Rig

LIMIT_S = 0.3
FASTEST_RAD_S = 3.0


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.take(1)
    rig.stream(1, 1.0, elbow=2.9)
    assert rig.controller._state.motion.fastest_rad_s > 0.5
    return rig


def rest_after(rig: Rig, *gaps_s: float) -> float:
    """Time to rest after the last setpoint, with these times between one call of the loop and the next."""
    began_s = rig.now_s
    for count in range(200):
        before = rig.elbow
        rig.now_s += gaps_s[count % len(gaps_s)]
        rig.elbow = rig.controller.update(rig.now_s).position_rad[1]
        assert abs(rig.elbow - before) <= FASTEST_RAD_S * PERIOD_S, "a jump"
        if not rig.controller.moving:
            return rig.now_s - began_s
    pytest.fail("it never came to rest")


@pytest.mark.parametrize("gap_s", [PERIOD_S, 0.012, 0.016, 0.024, 0.04])
def test_a_loop_that_is_late_every_time_is_at_rest_at_most_one_call_later(rig: Rig, gap_s: float) -> None:
    assert rest_after(rig, gap_s) <= LIMIT_S + gap_s


@pytest.mark.parametrize("gap_s", [0.016, 0.024, 0.04, 0.06])
def test_a_loop_that_has_been_late_begins_to_brake_the_sooner(rig: Rig, gap_s: float) -> None:
    for _ in range(20):
        rig.offer(1, 2.9)
        rig.now_s += gap_s
        rig.elbow = rig.controller.update(rig.now_s).position_rad[1]
    rig.offer(1, 2.9)
    assert rest_after(rig, gap_s) <= LIMIT_S


def test_what_a_loop_was_late_is_forgotten(rig: Rig) -> None:
    rig.now_s += 0.1
    rig.offer(1, 2.9)
    rig.controller.update(rig.now_s)
    rig.offer(1, -2.9)
    sooner_s = rest_after(rig, PERIOD_S)
    rig.take(2)
    rig.stream(2, 20.0, elbow=-2.9)
    rig.stream(2, 1.0, elbow=2.9)
    assert sooner_s + 0.05 < rest_after(rig, PERIOD_S) <= LIMIT_S


def test_a_setpoint_that_comes_late_moves_it_no_longer_than_one_in_time(rig: Rig) -> None:
    rig.run(0.12)
    rig.offer(1, 2.9, age_ms=140)
    assert rest_after(rig, PERIOD_S) <= LIMIT_S - 0.09


@pytest.mark.parametrize("gap_s", [0.05, 0.1, 0.28])
def test_a_loop_that_hangs_once_is_at_rest_soon_after(rig: Rig, gap_s: float) -> None:
    assert rest_after(rig, gap_s, *[PERIOD_S] * 200) <= LIMIT_S + PERIOD_S


def test_a_loop_that_hangs_past_the_limit_is_at_rest_at_once(rig: Rig) -> None:
    assert rest_after(rig, 0.6, *[PERIOD_S] * 200) <= 0.6 + 3 * PERIOD_S


def test_what_does_not_brake_is_not_hurried(rig: Rig) -> None:
    before = rig.controller._state.motion.fastest_rad_s
    rig.offer(1, 2.9)
    rig.now_s += 0.1
    rig.controller.update(rig.now_s)
    assert rig.controller._state.motion.fastest_rad_s == pytest.approx(before, rel=0.2)
