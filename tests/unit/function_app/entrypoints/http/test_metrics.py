"""The page ``/metrics``: its readers, its figures, and the number of its series."""

import re

import pytest

from device_agent.protocol import AckStatus
from function_app.adapters.local.monitoring.prometheus import PrometheusMetrics
from function_app.settings import Administration
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, Cloud, paired, problem

TOKEN = "a-token-of-the-monitoring"  # pragma: allowlist secret
LOCAL = "127.0.0.1"


def read(cloud: Cloud, address: str = LOCAL, **headers: str) -> str:
    answer = cloud.run(cloud.client(address=address).get("/metrics", headers=headers))
    if answer.status_code != 200:
        problem(answer, 401, "unauthorized")
        return ""
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    return answer.text


@pytest.fixture
def cloud(open_cloud: OpenCloud) -> Cloud:
    cloud = open_cloud()
    measured(cloud)
    cloud.start_ingest()
    return cloud


def measured(cloud: Cloud) -> None:
    """Replace the metrics before the services that use them are created."""
    cloud.functions.metrics = PrometheusMetrics()


def test_without_a_token_only_programs_of_this_machine_read_them(cloud: Cloud) -> None:
    assert read(cloud)
    assert read(cloud, "::1")
    assert not read(cloud, "192.0.2.7")
    assert not read(cloud, **{"X-Forwarded-For": "192.0.2.7"})
    assert not read(cloud, "192.0.2.7", Authorization="Bearer ")


def test_with_a_token_every_reader_needs_it(open_cloud: OpenCloud) -> None:
    cloud = open_cloud(administration=Administration(metrics_token=TOKEN))
    measured(cloud)
    assert not read(cloud)
    assert not read(cloud, Authorization="Bearer other")
    assert read(cloud, "192.0.2.7", Authorization=f"Bearer {TOKEN}")


def test_behind_a_proxy_a_token_is_needed(open_cloud: OpenCloud) -> None:
    cloud = open_cloud(trusted_proxies=1)
    measured(cloud)
    assert not read(cloud)


def test_requests_commands_acks_and_stops_are_counted(cloud: Cloud) -> None:
    with paired(cloud) as (anna, robot):
        robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)
        assert anna.start(robot.device, wait_ms=1000, wait_for="done").status_code == 200
        anna.post(f"/devices/{robot.device}/stop")
        anna.take_lease(robot.device)
        cloud.request("BREW", f"{API}/devices")
        cloud.clock.advance(1)
        text = read(cloud)
    requests = "telescope_http_request_duration_seconds_count"
    for line in (
        requests + r'{method="POST",route="/api/v1/devices/{device}/actions",status="200"} 1.0',
        requests + r'{method="other",route="/api/v1/devices",status="405"} 1.0',
        r'telescope_commands_total{kind="move_joints"} 1.0',
        r'telescope_acks_total{status="done"} ',
        r'telescope_action_duration_seconds_count{status="done"} 1.0',
        r'telescope_stops_total{outcome="',
        r'telescope_control_events_total{event="stop-ordered"} 1.0',
        r'telescope_part_status{part="tables"} 1.0',
        r'telescope_part_status{part="workers"} 0.0',
        r'telescope_ingest_messages_total{topic_class="conn"} ',
        r"telescope_workers 0.0",
        r"telescope_ingest_lag_seconds ",
    ):
        assert line in text, line
    assert robot.device not in text
    assert "anna" not in text


def test_the_number_of_series_does_not_depend_on_devices_or_paths(cloud: Cloud) -> None:
    def series() -> set[str]:
        return {re.sub(r" [^ ]+$", "", line) for line in read(cloud).splitlines() if not line.startswith("#")}

    for number in range(3):
        cloud.request("GET", f"{API}/devices/{number}")
    read(cloud)
    before = series()
    for number in range(20):
        cloud.request("GET", f"{API}/devices/other-{number}")
        cloud.request("GET", f"{API}/actions/unknown-{number}")
    assert len(series() - before) <= 40
    assert not [name for name in series() if "unknown" in name or "other-" in name]
