"""Rate limits: the algorithm, and its use by the HTTP API."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.common.problems import Problem
from function_app.domain.common.rate_limit import Rate, request
from function_app.services.identity import rate_limiter
from function_app.services.identity.rate_limiter import BURST_S, RateLimiter
from function_app.settings import RateLimits
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import API, Cloud, problem, settings

RATE = Rate(per_s=10, burst=30)


@given(st.lists(st.integers(0, 400), max_size=300))
def test_in_no_stretch_of_time_more_is_let_through_than_burst_and_rate_allow(pauses_ms: list[int]) -> None:
    now_ms, arrival_ms = 1e12, 0.0
    let: list[float] = []
    for pause_ms in pauses_ms:
        now_ms += pause_ms
        arrival_ms, wait_ms = request(RATE, arrival_ms, now_ms)
        if not wait_ms:
            let.append(now_ms)
    for first in range(len(let)):
        for last in range(first, len(let)):
            assert last - first + 1 <= RATE.burst + (let[last] - let[first]) / 1000 * RATE.per_s + 1e-6


def test_after_the_wait_that_is_told_it_is_let_through() -> None:
    arrival_ms, now_ms, wait_ms = 0.0, 1e12, 0.0
    for _ in range(RATE.burst):
        arrival_ms, wait_ms = request(RATE, arrival_ms, now_ms)
        assert wait_ms == 0
    arrival_ms, wait_ms = request(RATE, arrival_ms, now_ms)
    assert wait_ms == pytest.approx(100)
    assert request(RATE, arrival_ms, now_ms + wait_ms)[1] == 0


def test_a_clock_that_jumps_back_delays_one_request_only() -> None:
    arrival_ms, _ = request(RATE, 0.0, 2e12)
    _, wait_ms = request(RATE, arrival_ms, 1e12)
    assert wait_ms <= 100


def test_rate_zero_is_no_limit() -> None:
    assert request(Rate(0, 0), 0.0, 1e12) == (0.0, 0.0)


def test_of_many_names_the_newest_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rate_limiter, "KNOWN", 10)
    known = RateLimiter(per_s={"address": 1, "account": 1, "key": 1, "agent": 1}, clock=MovingClock())
    for number in range(1000):
        known.admit("address", str(number))
    assert len(known._arrivals) == 10
    for _ in range(BURST_S - 1):
        known.admit("address", "999")
    with pytest.raises(Problem, match="this address"):
        known.admit("address", "999")


def test_too_many_requests_of_an_account_wait_but_stop_never_does(tmp_path: Path) -> None:
    clock = MovingClock()
    with Cloud(
        replace(settings(tmp_path), rate_limits=RateLimits(account=1, address=0, key=0, agent=0)), clock=clock
    ) as cloud:
        anna, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
        for _ in range(BURST_S):
            assert anna.get("/accounts/me").status_code == 200
        refused = anna.get("/accounts/me")
        problem(refused, 429, "too-many-requests")
        assert 1 <= int(refused.headers["retry-after"]) <= 2
        assert bert.get("/accounts/me").status_code == 200
        assert anna.post("/stop").status_code in {200, 207}
        problem(anna.post("/devices/abcdefgh23-arm/stop"), 404, "device-unknown")
        problem(anna.post("/spaces/abcdefgh23/stop"), 404, "space-unknown")
        problem(anna.post("/devices/abcdefgh23-arm/stop/reset"), 429, "too-many-requests")
        clock.advance(int(refused.headers["retry-after"]))
        assert anna.get("/accounts/me").status_code == 200


def test_addresses_are_counted_before_authentication(tmp_path: Path) -> None:
    with Cloud(replace(settings(tmp_path), rate_limits=RateLimits(address=1, agent=1, account=0, key=0))) as cloud:
        here, there = cloud.client(address="192.0.2.1"), cloud.client(address="192.0.2.2")
        for _ in range(BURST_S):
            assert cloud.run(here.get(f"{API}/health")).status_code == 200
        problem(cloud.run(here.get(f"{API}/accounts/me")), 429, "too-many-requests")
        problem(cloud.run(here.post(f"{API}/devices/abcdefgh23-arm/stop")), 401, "unauthorized")
        assert cloud.run(there.get(f"{API}/health")).status_code == 200
        assert cloud.run(here.get("/")).status_code != 429
