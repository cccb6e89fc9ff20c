"""The load governor's levels, in virtual time."""

import pytest

from device_agent.runtime.load import CALM_S, MAX_LEVEL, REDUCTIONS, WINDOW_S, LoadGovernor
from device_agent.runtime.telemetry.rate_meter import RateMeter
from tests.harness.agent.load import PERIOD_S, advance, raise_level


def reduced(load: LoadGovernor) -> list[str]:
    return [work for work in REDUCTIONS if load.share(work) < 1]


def test_late_control_periods_reduce_cameras_then_perception_then_telemetry() -> None:
    load = LoadGovernor()
    now_s, orders = 1000.0, []
    for _ in range(MAX_LEVEL + 2):
        orders.append(reduced(load))
        now_s = advance(load, now_s, WINDOW_S + PERIOD_S, late_s=PERIOD_S)
    cameras, perception, telemetry = "cameras", "perception", "telemetry"
    everything = [cameras, perception, telemetry]
    assert orders == [[], [cameras], [cameras, perception], everything, everything]


def test_work_returns_in_the_reverse_order_after_a_calm_time() -> None:
    load = LoadGovernor()
    raise_level(load, MAX_LEVEL)
    now_s, levels = 2000.0, []
    while load.level:
        start_s, level = now_s, load.level
        while load.level == level:
            now_s = advance(load, now_s, PERIOD_S)
        levels.append(load.level)
        assert level == MAX_LEVEL or now_s - start_s >= CALM_S
    assert levels == [2, 1, 0]
    advance(load, now_s, 2 * CALM_S)
    assert load.level == 0


@pytest.mark.parametrize("late_s", [0.0, 0.9 * PERIOD_S])
def test_periods_in_time_reduce_nothing(late_s: float) -> None:
    load = LoadGovernor()
    advance(load, 1000.0, 5.0, late_s=late_s)
    assert load.level == 0


def test_one_late_period_after_a_pause_reduces_nothing() -> None:
    load = LoadGovernor()
    for second in range(5):
        load.record_period(1000.0 + 3 * second, late_s=2.0, period_s=PERIOD_S)
    assert load.level == 0


def test_a_rate_is_known_after_a_window_and_falls_with_the_messages() -> None:
    meter = RateMeter()
    for number in range(100):
        meter.record("tele/joints", number / 20)
    assert meter.rates_hz(4.9) == {}
    assert meter.rates_hz(5.0) == {"tele/joints": pytest.approx(20, abs=0.2)}
    assert meter.rates_hz(20.0) == {"tele/joints": 0.0}
