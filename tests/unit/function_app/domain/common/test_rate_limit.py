"""Rate limits: the algorithm, and its use by the HTTP API."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.common.problems import Problem
from function_app.domain.common.rate_limit import Rate, request
from function_app.services.identity import rate_limiter
from function_app.services.identity.rate_limiter import BURST_S, RateLimiter
from function_app.settings import RateLimits
from tests.fakes.clock import MovingClock
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, problem

RATE = Rate(per_s=10, burst=30)


@given(st.lists(st.integers(0, 400), max_size=300))
def test_no_interval_admits_more_than_burst_and_rate(pauses_ms: list[int]) -> None:
    now_ms, arrival_ms = 1e12, 0.0
    admitted: list[float] = []
    for pause_ms in pauses_ms:
        now_ms += pause_ms
        arrival_ms, wait_ms = request(RATE, arrival_ms, now_ms)
        if not wait_ms:
            admitted.append(now_ms)
    for first, last in itertools.combinations_with_replacement(range(len(admitted)), 2):
        allowed = RATE.burst + (admitted[last] - admitted[first]) / 1000 * RATE.per_s
        assert last - first + 1 <= allowed + 1e-6


def test_a_request_is_admitted_after_the_stated_wait() -> None:
    arrival_ms, now_ms, wait_ms = 0.0, 1e12, 0.0
    for _ in range(RATE.burst):
        arrival_ms, wait_ms = request(RATE, arrival_ms, now_ms)
        assert wait_ms == 0
    arrival_ms, wait_ms = request(RATE, arrival_ms, now_ms)
    assert wait_ms == pytest.approx(100)
    assert request(RATE, arrival_ms, now_ms + wait_ms)[1] == 0
    assert request(Rate(0, 0), 0.0, now_ms) == (0.0, 0.0), "no limit"
    arrival_ms, _ = request(RATE, 0.0, 2e12)
    assert request(RATE, arrival_ms, 1e12)[1] <= 100, "after the clock was set back"


def test_the_number_of_counted_names_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rate_limiter, "KNOWN", 10)
    limiter = RateLimiter(per_s={"address": 1, "account": 1, "key": 1, "agent": 1}, clock=MovingClock())
    for number in range(1000):
        limiter.admit("address", str(number))
    assert len(limiter._arrivals) == 10
    for _ in range(BURST_S - 1):
        limiter.admit("address", "999")
    with pytest.raises(Problem, match="this address"):
        limiter.admit("address", "999")


def test_rate_limits_of_an_account_do_not_apply_to_stop(open_cloud: OpenCloud) -> None:
    cloud = open_cloud(rate_limits=RateLimits(account=1, address=0, key=0, agent=0))
    anna, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
    statuses = [anna.get("/accounts/me").status_code for _ in range(BURST_S)]
    assert statuses == [200] * BURST_S
    rejected = anna.get("/accounts/me")
    problem(rejected, 429, "too-many-requests")
    assert 1 <= int(rejected.headers["retry-after"]) <= 2
    assert bert.get("/accounts/me").status_code == 200
    assert anna.post("/stop").status_code in {200, 207}
    problem(anna.post("/devices/abcdefgh23-arm/stop"), 404, "device-unknown")
    problem(anna.post("/spaces/abcdefgh23/stop"), 404, "space-unknown")
    problem(anna.post("/devices/abcdefgh23-arm/stop/reset"), 429, "too-many-requests")
    cloud.clock.advance(int(rejected.headers["retry-after"]))
    assert anna.get("/accounts/me").status_code == 200


def test_addresses_are_counted_before_authentication(open_cloud: OpenCloud) -> None:
    cloud = open_cloud(rate_limits=RateLimits(address=1, agent=1, account=0, key=0))
    first, second = cloud.client(address="192.0.2.1"), cloud.client(address="192.0.2.2")
    for _ in range(BURST_S):
        assert cloud.run(first.get(f"{API}/health")).status_code == 200
    problem(cloud.run(first.get(f"{API}/accounts/me")), 429, "too-many-requests")
    problem(cloud.run(first.post(f"{API}/devices/abcdefgh23-arm/stop")), 401, "unauthorized")
    assert cloud.run(second.get(f"{API}/health")).status_code == 200
