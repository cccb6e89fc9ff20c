"""Health and latency pages: an injected fault is raised and ends; latencies are measured and saved."""

import contextlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import PATIENCE_MS, pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Api, Machine
from tests.harness.network.brokers import wait_until

MEASURED = 20
UR5_HTTP_MS, UR5_XMPP_MS = "2994.6", "824.25"


@contextlib.contextmanager
def inject_fault(machine: Machine, device: str, fault: str) -> Iterator[Path]:
    """Inject a fault into a simulated device until the context exits or the file is deleted."""
    (folder,) = {path.parent / "faults" for path in machine.home.rglob("agent.toml")}
    folder.mkdir(exist_ok=True)
    file = folder / f"{device}.toml"
    file.write_text(fault)
    try:
        yield file
    finally:
        file.unlink(missing_ok=True)


def go(page: Page, machine: Machine, address: str) -> None:
    """Navigate to a page of the console without a reload."""
    page.evaluate("address => { location.hash = address; }", address)
    assert page.url.startswith(machine.url)


def test_a_fault_is_raised_shown_and_ended_and_a_trend_shows_measurements(
    browser: Browser, laboratory: Machine
) -> None:
    with laboratory.api() as api:
        ids = {name: api.device(name)["id"] for name in ("thermometer", "co2")}
        # The trend shows the wrong values immediately; the detectors raise a fault during the other checks.
        with (
            inject_fault(laboratory, "co2", "drift = { co2_ppm = 90000.0 }"),
            pages(browser, laboratory) as (ann,),
            inject_fault(laboratory, "thermometer", "unreachable = true") as file,
        ):
            check_raised(ann, laboratory, ids["thermometer"])
            check_acknowledged_and_ended(ann, file)
            check_trend(ann, laboratory, ids["co2"])


def check_raised(page: Page, machine: Machine, device: str) -> None:
    """The device list, the health page and the device page show the fault without a reload."""
    row = page.locator(f"[data-testid=device-row][data-device='{device}']")
    expect(row.get_by_text("1 fault")).to_be_visible()
    row.get_by_role("link").first.click()
    chip = page.get_by_test_id("health-chip")
    expect(chip).to_have_attribute("data-count", "1")
    page.get_by_role("link", name="Health", exact=True).click()
    line = page.locator(f"[data-testid=health-row][data-device='{device}']")
    expect(line).to_have_attribute("data-health", "fault")
    expect(line).to_contain_text("does not respond")
    assert page.get_by_test_id("health-row").first.get_attribute("data-health") == "fault", "the worst device is first"
    assert_good_page(page, "health")
    go(page, machine, f"#/devices/{device}/health")


def check_acknowledged_and_ended(page: Page, cause: Path) -> None:
    """Acknowledge by keyboard; the fault ends with its cause."""
    fault = page.get_by_test_id("fault")
    expect(fault).to_have_attribute("data-state", "raised")
    button = page.get_by_test_id("acknowledge")
    button.focus()
    page.keyboard.press("Enter")
    expect(fault).to_have_attribute("data-state", "acknowledged")
    expect(fault).to_contain_text("Acknowledged by demo")
    assert page.evaluate("() => document.activeElement.closest('[data-testid=fault]') !== null"), "the focus is lost"
    assert_good_page(page, "health-fault")
    cause.unlink()
    expect(page.get_by_test_id("open-faults")).to_have_attribute("data-count", "0")
    expect(fault).to_have_count(0)
    page.get_by_text("Past", exact=True).click()
    past = page.get_by_test_id("faults-past").get_by_test_id("fault").first
    expect(past).to_have_attribute("data-state", "cleared")
    expect(past).to_contain_text("Acknowledged by demo")
    past.locator("summary").click()
    expect(past.locator(".event-list")).to_contain_text("Fault acknowledged")


def check_trend(page: Page, machine: Machine, device: str) -> None:
    """The trend shows the excursion, the band and the fault; keyboard and table access work."""
    go(page, machine, f"#/devices/{device}/health")
    page.get_by_text("10 min", exact=True).click()
    now = page.get_by_test_id("trend-now")
    wait_until(lambda: float(now.get_attribute("data-value") or "0") > 2000, "a wrong value")
    expect(now).to_contain_text("outside its limits")
    expect(page.get_by_test_id("trend-fault")).to_have_attribute("data-code", "co2.co2_ppm", timeout=2 * PATIENCE_MS)
    row = page.get_by_test_id("watched-row").first
    expect(row).to_have_attribute("data-field", "co2.co2_ppm")
    expect(row).to_contain_text("Limit exceeded")
    expect(row).to_contain_text("Open the door or a window")  # advice of the room's manifest
    chart = page.get_by_test_id("series")
    wait_until(lambda: int(chart.get_attribute("data-points") or "0") > 5, "points")
    chart.focus()
    page.keyboard.press("ArrowLeft")
    before = chart.get_attribute("aria-valuetext")
    assert "ppm" in (before or "")
    expect(page.get_by_test_id("reading-at")).to_have_text(before or "")
    page.keyboard.press("Home")
    assert chart.get_attribute("aria-valuetext") != before
    assert_good_page(page, "trend")
    page.get_by_text("Table", exact=True).click()
    expect(page.get_by_test_id("trend-table").get_by_role("row")).not_to_have_count(1)


def test_latencies_are_measured_plotted_with_reference_values_and_saved(browser: Browser, laboratory: Machine) -> None:
    with laboratory.api() as api:
        device = api.device("light")["id"]
        with pages(browser, laboratory) as (ann,):
            go(ann, laboratory, f"#/devices/{device}/latency")
            ann.get_by_test_id("measure").click()
            measured = ann.get_by_test_id("probe-samples")
            chart = ann.get_by_test_id("latency-samples")
            wait_until(lambda: int(chart.get_attribute("data-samples") or "0") > 0, "samples while it measures")
            expect(measured).to_have_attribute("data-busy", "false", timeout=2 * PATIENCE_MS)
            expect(measured).to_have_attribute("data-count", str(3 * MEASURED))

            # All samples are stored and plotted once.
            ann.get_by_test_id("latency-path").select_option("operator-cloud")
            for transport in ("http", "websocket"):
                line = ann.locator(f"[data-testid=latency-line][data-transport={transport}]")
                assert int(line.get_attribute("data-count") or "0") >= MEASURED
            # The cloud stores its own measurements of the same requests asynchronously.
            kinds = (("http", "operator-device"), ("mqtt", "command-started"))
            wait_until(lambda: all(count_samples(api, device)[kind] >= MEASURED for kind in kinds), "all to be stored")
            counts = count_samples(api, device)
            ann.get_by_test_id("latency-path").select_option("operator-device")
            assert chart.get_attribute("data-samples") == str(counts["http", "operator-device"])
            for ms in (UR5_HTTP_MS, UR5_XMPP_MS):
                expect(ann.locator(f"[data-testid=published][data-ms='{ms}']")).to_be_visible()
            assert int(chart.get_attribute("data-references") or "0") > 0

            # The saved file contains the plotted samples.
            ann.get_by_test_id("latency-path").select_option("")
            drawn = int(chart.get_attribute("data-samples") or "0")
            with ann.expect_download() as download:
                ann.get_by_test_id("latency-csv").click()
            rows = Path(download.value.path()).read_text().splitlines()
            assert rows[0] == "device,label,transport,path,at,ms"
            assert len(rows) - 1 == drawn >= 3 * MEASURED
            assert_good_page(ann, "times-device")
            go(ann, laboratory, "#/latency")
            expect(ann.get_by_test_id("latency-line").first).to_be_visible()
            assert_good_page(ann, "times")


def count_samples(api: Api, device: str) -> dict[tuple[str, str], int]:
    """Number of stored samples by transport and path."""
    items = api.get(f"/devices/{device}/latency")["items"]
    return defaultdict(int, {(item["transport"], item["path"]): item["count"] for item in items})
