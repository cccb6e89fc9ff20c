"""Late control loops and late setpoints."""

import pytest

from tests.fakes.drivers import PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, leased

LIMIT_S = 0.3
FASTEST_RAD_S = 3.0


@pytest.fixture
def fixture() -> ControllerFixture:
    fixture = leased()
    fixture.stream(1, 1.0, elbow=2.9)
    assert fixture.controller._state.motion.fastest_rad_s > 0.5
    return fixture


def update_after(fixture: ControllerFixture, gap_s: float) -> None:
    fixture.now_s += gap_s
    fixture.elbow = fixture.controller.update(fixture.now_s).position_rad[1]


def rest_after(fixture: ControllerFixture, *gaps_s: float) -> float:
    """Time from the last setpoint to rest, with these times between one call of the loop and the next."""
    start_s = fixture.now_s
    for count in range(200):
        before = fixture.elbow
        update_after(fixture, gaps_s[count % len(gaps_s)])
        assert abs(fixture.elbow - before) <= FASTEST_RAD_S * PERIOD_S, "a jump"
        if not fixture.controller.moving:
            return fixture.now_s - start_s
    pytest.fail("it never came to rest")


@pytest.mark.parametrize("gap_s", [PERIOD_S, 0.012, 0.016, 0.024, 0.04])
def test_a_constantly_late_loop_rests_at_most_one_call_later(fixture: ControllerFixture, gap_s: float) -> None:
    assert rest_after(fixture, gap_s) <= LIMIT_S + gap_s


@pytest.mark.parametrize("gap_s", [0.016, 0.024, 0.04, 0.06])
def test_a_loop_that_was_late_brakes_earlier(fixture: ControllerFixture, gap_s: float) -> None:
    for _ in range(20):
        fixture.offer(1, 2.9)
        update_after(fixture, gap_s)
    fixture.offer(1, 2.9)
    assert rest_after(fixture, gap_s) <= LIMIT_S


def test_loop_delay_decays_and_does_not_slow_motion_that_is_not_braking(fixture: ControllerFixture) -> None:
    before = fixture.controller._state.motion.fastest_rad_s
    fixture.offer(1, 2.9)
    update_after(fixture, 0.1)
    assert fixture.controller._state.motion.fastest_rad_s == pytest.approx(before, rel=0.2)
    fixture.offer(1, -2.9)
    sooner_s = rest_after(fixture, PERIOD_S)
    fixture.grant(2)
    fixture.stream(2, 20.0, elbow=-2.9)
    fixture.stream(2, 1.0, elbow=2.9)
    assert sooner_s + 0.05 < rest_after(fixture, PERIOD_S) <= LIMIT_S


def test_a_late_setpoint_does_not_extend_the_motion(fixture: ControllerFixture) -> None:
    fixture.run(0.12)
    fixture.offer(1, 2.9, age_ms=140)
    assert rest_after(fixture, PERIOD_S) <= LIMIT_S - 0.09


@pytest.mark.parametrize(
    ("gap_s", "limit_s"), [*((gap_s, LIMIT_S + PERIOD_S) for gap_s in (0.05, 0.1, 0.28)), (0.6, 0.6 + 3 * PERIOD_S)]
)
def test_a_loop_that_hangs_once_is_at_rest_soon_after(fixture: ControllerFixture, gap_s: float, limit_s: float) -> None:
    assert rest_after(fixture, gap_s, *[PERIOD_S] * 200) <= limit_s
