"""The autonomy page shows who moved a robot; the timeline shows who controlled which robot when."""

from pathlib import Path

from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine, enroll
from tests.harness.browser.steering import move_the_elbow, operator, release_control
from tests.harness.network.brokers import wait_until


def value(page: Page, name: str) -> float:
    """Value of a metric or figure; NaN: undefined."""
    return float(page.get_by_test_id(name).get_attribute("data-value") or "nan")


def newest_epoch(machine: Machine) -> int:
    """Epoch of the newest session of the arm; 0 without one."""
    with machine.api() as api:
        items = api.get(f"/devices/{api.device()['id']}/sessions", limit=1)["items"]
    return int(items[0]["epoch"]) if items else 0


def test_a_movement_and_a_slider_have_shares_and_sessions(browser: Browser, machine: Machine) -> None:
    with machine.api() as api:
        api.free_device()
    former = newest_epoch(machine)
    with operator(browser, machine) as page:
        page.get_by_test_id("movement-wave").click()
        expect(page.get_by_test_id("action-status")).to_have_attribute("data-status", "done")
        move_the_elbow(page, machine)
        release_control(page)
        page.get_by_test_id("to-autonomy").click()

        # The agent reports after a second of rest, and the page asks every ten seconds.
        sessions = page.get_by_test_id("session")

        def moved(source: str, task: str) -> int:
            """Number of new sessions of a task in which a source moved the arm."""
            shown = [each for each in sessions.all() if int(each.get_attribute("data-epoch") or "0") > former]
            mine = [each for each in shown if each.get_attribute("data-task") == task]
            return sum(float(each.get_attribute(f"data-{source}-s") or "0") > 0 for each in mine)

        wait_until(lambda: moved("machine", "wave") == 1, "the session of the movement")
        wait_until(lambda: moved("operator", "") >= 1, "the session of the slider")
        assert moved("operator", "wave") == 0, "the operator moved the arm in the movement"
        wait_until(lambda: value(page, "metric-hti") > 0 and value(page, "metric-mti") > 0, "both shares")
        hti, mti = value(page, "metric-hti"), value(page, "metric-mti")
        assert abs(hti + mti - 1) < 1e-9
        assert abs(value(page, "metric-mtia") - mti / hti) < 1e-6
        expect(page.locator("[data-testid=task][data-task=wave]")).to_be_visible()
        expect(page.get_by_test_id("share-column")).to_have_count(1)
        assert value(page, "figure-takeover") > 0
        assert_good_page(page, "autonomy")
        assert_good_page(page, "autonomy-sessions", part="sessions")
        page.get_by_text("Table", exact=True).click()
        expect(page.get_by_test_id("share-table").get_by_role("row")).to_have_count(2)


def test_the_timeline_shows_a_movement_a_person_and_a_stop(browser: Browser, machine: Machine) -> None:
    with machine.api() as api:
        api.free_device()
        device = api.device()["id"]
    former = newest_epoch(machine)
    with operator(browser, machine) as page:
        page.get_by_test_id("movement-wave").click()
        expect(page.get_by_test_id("action-status")).to_have_attribute("data-status", "done")
        with machine.api() as api:
            api.post(f"/devices/{device}/stop")
            api.post(f"/devices/{device}/stop/reset")
        page.get_by_role("link", name="Timeline").click()
        row = page.locator(f"[data-testid=timeline-row][data-device={device}]")

        def new_sessions(by: str) -> int:
            shown = row.locator(f"[data-testid=timeline-session][data-by={by}]").all()
            return sum(int(each.get_attribute("data-epoch") or "0") > former for each in shown)

        wait_until(lambda: new_sessions("action") == 1, "the session of the movement")
        expect(row.locator("[data-testid=timeline-mark][data-kind=stop]").first).to_be_visible()
        assert page.locator("[data-testid=timeline-row]").count() == 1, "room devices are not robots"
        assert_good_page(page, "timeline")
        page.get_by_text("Table", exact=True).click()
        expect(page.get_by_test_id("timeline-table").get_by_text("wave").first).to_be_visible()
        assert_good_page(page, "timeline-table")


def test_a_robot_that_has_not_moved_has_no_shares_and_no_sessions(
    browser: Browser, machine: Machine, tmp_path: Path
) -> None:
    with machine.api() as api, pages(browser, machine) as (page,):
        agent = enroll(machine, api, tmp_path, "idle=ur5")
        try:
            page.evaluate("id => { location.hash = `#/devices/${id}/autonomy`; }", f"{agent}-idle")
            expect(page.get_by_test_id("no-motion")).to_be_visible()
            expect(page.get_by_test_id("metric-hti")).to_have_count(0)
            expect(page.get_by_text("No one has had control of this robot yet.")).to_be_visible()
            assert_good_page(page, "autonomy-empty")
        finally:
            api.http.delete(f"/agents/{agent}").raise_for_status()
