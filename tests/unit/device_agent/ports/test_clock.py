"""The estimate of the cloud's clock."""

import time

import pytest

from device_agent.ports.clock import CloudClock, tick_ms

HOUR_MS = 3_600_000


@pytest.fixture
def clock() -> CloudClock:
    """A clock after one exchange of 2 ms, in which the cloud's clock was equal to the agent's."""
    clock = CloudClock()
    observe(clock, offset_ms=0, round_trip_ms=2)
    return clock


def observe(clock: CloudClock, *, offset_ms: int, round_trip_ms: int) -> None:
    """One exchange that ends now."""
    now_ms = tick_ms()
    middle_ms = now_ms - round_trip_ms // 2
    clock.observe(server_ms=middle_ms + offset_ms, sent_tick_ms=now_ms - round_trip_ms, received_tick_ms=now_ms)


def offset_ms(clock: CloudClock) -> float:
    now_ms = clock.now_ms()
    assert now_ms is not None
    return now_ms - time.monotonic() * 1000


def test_a_slower_exchange_does_not_replace_a_better_estimate(clock: CloudClock) -> None:
    observe(clock, offset_ms=30, round_trip_ms=100)
    assert abs(offset_ms(clock)) < 10


@pytest.mark.parametrize("step_ms", [HOUR_MS, -HOUR_MS, 400 * 24 * HOUR_MS])
def test_a_step_of_the_clouds_clock_is_followed_although_the_exchange_was_slower(
    clock: CloudClock, step_ms: int
) -> None:
    observe(clock, offset_ms=step_ms, round_trip_ms=100)
    assert abs(offset_ms(clock) - step_ms) < 110
