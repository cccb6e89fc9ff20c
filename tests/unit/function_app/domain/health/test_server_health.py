import pytest

from function_app.domain.health.server_health import Finding, Status, disk_space, worst

MB = 1_000_000


@pytest.mark.parametrize(
    ("free_mb", "expected"),
    [(None, "ok"), (600, "ok"), (500, "ok"), (499, "degraded"), (50, "degraded"), (49, "failed"), (0, "failed")],
)
def test_a_disk_is_degraded_below_the_limit_and_failed_below_a_tenth_of_it(free_mb: int | None, expected: str) -> None:
    found = disk_space(None if free_mb is None else free_mb * MB, 500 * MB)
    assert found.status == expected
    assert ("Free disk space" in found.message) == (expected != "ok")


def test_the_worst_status_counts() -> None:
    ok, degraded, failed = (Finding(status, "") for status in Status)
    assert worst([]) is Status.OK
    assert worst([ok, degraded]) is Status.DEGRADED
    assert worst([degraded, failed, ok]) is Status.FAILED
