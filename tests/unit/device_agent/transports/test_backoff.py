"""Connection attempts become rare while links fail, and differ between agents."""

import random
from types import SimpleNamespace

import pytest

from device_agent.transports import backoff
from device_agent.transports.backoff import MAX_S, MIN_S, BackOff


class Attempts:
    """Attempts of one agent on a virtual clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        self._backoff = BackOff()
        monkeypatch.setattr(backoff, "time", SimpleNamespace(monotonic=lambda: self.now_s))

    def delay_s(self, *, connected_s: float) -> float:
        """The delay after an attempt whose connection lasted this long."""
        self._backoff.attempt()
        self.now_s += connected_s
        return self._backoff.wait_s()


@pytest.mark.parametrize("connected_s", [0.0, MAX_S - 0.1])
def test_delays_double_up_to_the_maximum_until_a_link_is_stable(
    monkeypatch: pytest.MonkeyPatch, connected_s: float
) -> None:
    attempts, longest_s = Attempts(monkeypatch), MIN_S
    for _ in range(50):
        assert MIN_S / 2 <= attempts.delay_s(connected_s=connected_s) <= longest_s
        longest_s = min(2 * longest_s, MAX_S)
    assert attempts.delay_s(connected_s=MAX_S + 0.1) <= MIN_S


def test_unstable_links_cause_few_attempts(monkeypatch: pytest.MonkeyPatch) -> None:
    random.seed(4)
    attempts = Attempts(monkeypatch)
    for _ in range(150):
        attempts.now_s += attempts.delay_s(connected_s=0.05)
    assert attempts.now_s > 600


def test_delays_of_agents_are_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    agents = [Attempts(monkeypatch) for _ in range(200)]
    last_s = [[agent.delay_s(connected_s=0.0) for _ in range(8)][-1] for agent in agents]
    assert max(last_s) - min(last_s) > MAX_S / 2
    assert sum(delay_s < MAX_S / 4 for delay_s in last_s) < 120
