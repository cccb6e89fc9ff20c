"""Connection attempts become rare while links fail, and differ between agents."""

import random

import pytest

from device_agent.transports import backoff
from device_agent.transports.backoff import MAX_S, MIN_S, BackOff


class Clock:
    now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(backoff, "time", clock)
    return clock


def waits(back: BackOff, clock: Clock, count: int, *, each_s: float) -> list[float]:
    delays = []
    for _ in range(count):
        back.attempt()
        clock.now_s += each_s
        delays.append(back.wait_s())
    return delays


@pytest.mark.parametrize("each_s", [0.0, MAX_S - 0.1])
def test_delays_double_up_to_the_maximum(clock: Clock, each_s: float) -> None:
    longest = MIN_S
    for wait_s in waits(BackOff(), clock, 50, each_s=each_s):
        assert MIN_S / 2 <= wait_s <= longest
        longest = min(2 * longest, MAX_S)


def test_unstable_links_cause_few_attempts(clock: Clock) -> None:
    random.seed(4)
    back, attempts = BackOff(), 0
    while clock.now_s < 600:
        (wait_s,) = waits(back, clock, 1, each_s=0.05)
        clock.now_s += wait_s
        attempts += 1
    assert attempts < 150


def test_a_stable_link_resets_the_delay(clock: Clock) -> None:
    back = BackOff()
    waits(back, clock, 20, each_s=0.0)
    assert waits(back, clock, 1, each_s=MAX_S + 0.1)[0] <= MIN_S


def test_delays_of_agents_are_spread(clock: Clock) -> None:
    last = [waits(BackOff(), clock, 8, each_s=0.0)[-1] for _ in range(200)]
    assert max(last) - min(last) > MAX_S / 2
    assert sum(wait_s < MAX_S / 4 for wait_s in last) < 120
