"""Options, allowed hosts, key files and metrics of a load test."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from device_agent.load_generator.enrollment import FILE, Keys
from device_agent.load_generator.metrics import Metrics, percentile
from device_agent.load_generator.options import LoadOptions, LoadTestError

OPTIONS = LoadOptions(cloud="https://telescope.example:8443")


@pytest.mark.parametrize(
    "changes",
    [
        *({"cloud": cloud} for cloud in ("telescope.example", "mqtt://telescope.example")),
        {"cloud": "http://telescope.example", "ca": Path("ca.pem")},
        {"type": "a type"},
        *({"count": count} for count in (0, 20_001)),
        *({"rate_hz": rate_hz} for rate_hz in (0.0, 51.0, float("nan"))),
        {"joints": 129},
        *({"seconds": seconds} for seconds in (0.0, float("inf"))),
        {"spread_s": 61.0},
    ],
)
def test_invalid_options_are_named(changes: dict[str, Any]) -> None:
    OPTIONS.check()
    with pytest.raises(LoadTestError, match="--"):
        replace(OPTIONS, **changes).check()


@pytest.mark.parametrize(
    ("changes", "host", "allowed"),
    [
        ({}, "telescope.example", True),
        *(({}, host, False) for host in ("broker.example", "127.0.0.1", "")),
        ({"broker": "broker.example"}, "broker.example", True),
        ({"cloud": "http://localhost:8080"}, "127.0.0.1", True),
    ],
)
def test_only_named_hosts_are_contacted(changes: dict[str, Any], host: str, allowed: bool) -> None:
    assert replace(OPTIONS, **changes).may_connect_to(host) is allowed


def test_keys_are_reused_and_private(tmp_path: Path) -> None:
    def public(count: int) -> list[bytes]:
        keys = Keys(tmp_path / "home").first(count)
        return [key.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw) for key in keys]

    few, more = public(2), public(5)
    assert more[:2] == few
    assert len(set(more)) == 5
    assert public(3) == more[:3]
    assert (tmp_path / "home" / FILE).stat().st_mode & 0o777 == 0o600
    (tmp_path / "home" / FILE).write_text('["no key"]')
    with pytest.raises(LoadTestError, match="--home"):
        public(1)


def test_percentiles_are_observed_values() -> None:
    assert percentile([], 99) is None
    assert percentile([3.0], 99) == 3.0
    assert percentile([float(number) for number in range(1, 201)], 99) == 198.0
    assert percentile([2.0, 1.0], 50) == 1.0


def test_summary_counts_since_the_steady_phase_and_lines_since_the_previous_one() -> None:
    metrics = Metrics(2)
    metrics.record_connected()
    metrics.counts.out = 1000
    metrics.lag_ms.append(500.0)
    metrics.start_steady()
    metrics.counts.out, metrics.counts.out_bytes, metrics.counts.missed = 1090, 9000, 10
    metrics.counts.out_qos1, metrics.counts.confirmed = 3, 2
    metrics.lag_ms += [1.0, 2.0]
    line = metrics.line(4000)
    assert all(text in line for text in ("1 of 2 connected", "lag p99 2.0 ms", "missed 10", "2 kB per agent"))
    metrics.record_error("unreachable")
    assert "most frequent error: unreachable (1 times)" in metrics.line(4000)
    summary = metrics.summary(4000)
    assert summary["out_bytes_per_message"] == 100.0
    assert summary["missed_share"] == pytest.approx(0.1)
    assert summary["unconfirmed"] == 1
    assert summary["lag_ms"] == {"p50": 1.0, "p99": 2.0, "p100": 2.0, "count": 2}
    assert summary["confirm_ms"]["p99"] is None
    assert summary["errors"] == {"unreachable": 1}
