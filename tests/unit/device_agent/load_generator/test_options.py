"""What a swarm may be, whom it may speak to, what it keeps, and how its figures are made."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from device_agent.load_generator.enrollment import FILE, Keys
from device_agent.load_generator.metrics import Metrics, percentile
from device_agent.load_generator.options import LoadOptions, LoadTestError

PLAN = LoadOptions(cloud="https://telescope.example:8443")


@pytest.mark.parametrize(
    "changes",
    [
        {"cloud": "telescope.example"},
        {"cloud": "mqtt://telescope.example"},
        {"cloud": "http://telescope.example", "ca": Path("ca.pem")},
        {"type": "a type"},
        {"count": 0},
        {"count": 20_001},
        {"rate_hz": 0.0},
        {"rate_hz": 51.0},
        {"rate_hz": float("nan")},
        {"joints": 129},
        {"seconds": 0.0},
        {"seconds": float("inf")},
        {"spread_s": 61.0},
    ],
)
def test_what_cannot_be_run_is_refused_by_the_name_of_its_option(changes: dict[str, Any]) -> None:
    PLAN.check()
    with pytest.raises(LoadTestError, match="--"):
        replace(PLAN, **changes).check()


def test_only_hosts_that_were_named_are_spoken_to() -> None:
    assert PLAN.may_connect_to("telescope.example")
    assert not PLAN.may_connect_to("broker.example")
    assert not PLAN.may_connect_to("127.0.0.1")
    assert replace(PLAN, broker="broker.example").may_connect_to("broker.example")
    assert not PLAN.may_connect_to("")
    assert replace(PLAN, cloud="http://localhost:8080").may_connect_to("127.0.0.1")


def test_the_next_run_has_the_same_keys_and_nobody_else_may_read_them(tmp_path: Path) -> None:
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


def test_percentiles_are_values_that_were_seen() -> None:
    assert percentile([], 99) is None
    assert percentile([3.0], 99) == 3.0
    assert percentile([float(number) for number in range(1, 201)], 99) == 198.0
    assert percentile([2.0, 1.0], 50) == 1.0


def test_rates_are_those_since_all_were_there_and_a_line_those_since_the_last() -> None:
    figures = Metrics(2)
    figures.up()
    figures.counts.out = 1000
    figures.lag_ms.append(500.0)
    figures.steady()
    figures.counts.out, figures.counts.out_bytes, figures.counts.missed = 1090, 9000, 10
    figures.counts.asked, figures.counts.confirmed = 3, 2
    figures.lag_ms += [1.0, 2.0]
    line = figures.line(4000)
    assert "1 of 2 connected" in line
    assert "lag p99 2.0 ms" in line
    assert "missed 10" in line
    assert "2 kB an agent" in line
    figures.trouble("no way there")
    assert "trouble: no way there (1 times)" in figures.line(4000)
    told = figures.summary(4000)
    assert told["out_bytes_per_message"] == 100.0
    assert told["missed_share"] == pytest.approx(0.1)
    assert told["unconfirmed"] == 1
    assert told["lag_ms"] == {"p50": 1.0, "p99": 2.0, "p100": 2.0, "count": 2}
    assert told["confirm_ms"]["p99"] is None
    assert told["troubles"] == {"no way there": 1}
