"""The page of a recorded session: one of a robot, and others that the test serves in place of the product's store."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.browser.recorded_session import CAMERA, EPOCH, RecordedSession, record_session
from tests.harness.browser.steering import move_the_elbow, operator, release_control, take_control
from tests.harness.network.brokers import wait_until

ROW = "[data-testid=session-row] [data-kind=row]"


@contextmanager
def opened(browser: Browser, machine: Machine, session: RecordedSession, *others: RecordedSession) -> Iterator[Page]:
    """The page of a session, opened from the list of sessions."""
    with machine.api() as api:
        device = api.device()["id"]
    with pages(browser, machine) as (page,):
        session.serve(page.context, device, *others)
        page.evaluate("id => { location.hash = `#/devices/${id}/autonomy`; }", device)
        page.locator(f"[data-testid=session][data-epoch='{session.epoch}']").get_by_test_id("open-recording").click()
        expect(page.get_by_test_id("recorded-session")).to_be_visible()
        yield page


def seek(page: Page, *keys: str) -> None:
    """Moves the cursor with keys."""
    for key in keys:
        page.get_by_test_id("session-cursor").press(key)


def test_the_cursor_shows_rows_images_and_what_the_operator_saw(browser: Browser, machine: Machine) -> None:
    with opened(browser, machine, record_session(2)) as page:
        expect(page.locator(ROW)).to_have_attribute("data-source", "operator")
        seek(page, "Shift+ArrowRight", "Shift+ArrowRight")
        expect(page.get_by_test_id("session-clock")).to_have_text("0:20.0 of 2:00.0")
        expect(page.get_by_text("84 ms before this command")).to_be_visible()
        page.get_by_test_id("show-seen").click()
        expect(page.get_by_text("What the operator saw, 84 ms old")).to_be_visible()
        expect(page.locator(f"[data-topic='{CAMERA}'] canvas")).to_have_attribute("width", "64")
        expect(page.locator("[data-testid=session-plot] canvas")).to_be_visible()
        assert_good_page(page, "session")
        seek(page, "PageUp")
        expect(page.locator(ROW)).to_have_attribute("data-source", "hold")
        expect(page.get_by_test_id("show-seen")).to_be_disabled()


def test_a_time_without_data_is_shown_as_such(browser: Browser, machine: Machine) -> None:
    session = record_session(3)
    assert session.recording is not None
    del session.recording["segments"][1]
    session.recording["missing"] = [{"segment": 1, "cause": "lost"}]
    with opened(browser, machine, session) as page:
        gap = page.get_by_test_id("recording-gaps").locator("[data-cause=lost]")
        expect(gap).to_contain_text("1:00.0 – 2:00.0")
        gap.get_by_role("button").click()
        seek(page, "Shift+ArrowRight")
        expect(page.get_by_text("No data at this time", exact=True).first).to_be_visible()
        seek(page, "PageUp")
        expect(page.locator(ROW)).to_be_visible()
        assert_good_page(page, "session-gap")


def test_two_sessions_are_compared(browser: Browser, machine: Machine) -> None:
    other = record_session(1, epoch=EPOCH + 1, delay_ms=500)
    with opened(browser, machine, record_session(2), other) as page:
        expect(page.get_by_test_id("compare-session")).to_be_enabled()
        assert_good_page(page, "session-choice")  # the names of sessions are wider than a phone
        page.get_by_test_id("compare-session").select_option(str(other.epoch))
        expect(page.get_by_test_id("compare-joints").locator("tbody tr")).to_have_count(6)
        expect(page.get_by_test_id("compare-figures").locator("[data-row=recorded]")).to_contain_text("2:00.01:00.0")
        expect(page.get_by_test_id("compared-bar")).to_be_visible()
        elbow = page.get_by_test_id("compare-joints").locator("[data-joint=elbow]")
        expect(elbow.locator("td").first).not_to_have_text("0.0°")
        seek(page, "Shift+ArrowRight")
        assert_good_page(page, "session-compared")
        page.get_by_test_id("align-second-s").fill("0.5")
        page.get_by_test_id("align-second-s").blur()
        expect(elbow.locator("td").first).to_have_text("0.0°")  # it does the same half a second later
        page.reload()  # the address keeps the comparison
        expect(elbow.locator("td").first).to_have_text("0.0°")
        page.get_by_test_id("align-first-s").fill("100")
        page.get_by_test_id("align-first-s").blur()
        page.get_by_test_id("align-second-s").fill("300")
        page.get_by_test_id("align-second-s").blur()
        expect(page.get_by_test_id("compare-state")).to_have_attribute("data-state", "apart")
        page.get_by_test_id("end-comparison").click()
        expect(page.get_by_test_id("compared-bar")).to_have_count(0)


def test_events_of_minutes_that_are_not_loaded_are_listed(browser: Browser, machine: Machine) -> None:
    session = record_session(4)
    del session.files[f"{EPOCH}-2.mcap"]
    with opened(browser, machine, session) as page:
        fault = page.get_by_test_id("session-events").locator("[data-group=fault]")
        expect(fault).to_contain_text("The robot's controller does not respond.")
        fault.get_by_role("button").click()
        expect(page.get_by_test_id("session-clock")).to_have_text("2:30.0 of 4:00.0")


def test_playing_moves_the_cursor_and_pauses_at_the_end(browser: Browser, machine: Machine) -> None:
    with opened(browser, machine, record_session(1)) as page:
        expect(page.locator(ROW)).to_be_visible()
        page.get_by_test_id("session-speed").select_option("30")
        page.get_by_test_id("session-play").click()
        expect(page.get_by_test_id("session-clock")).to_have_text("1:00.0 of 1:00.0")
        expect(page.get_by_test_id("session-play")).to_have_attribute("aria-pressed", "false")


def test_episodes_are_rated_split_trimmed_and_deleted(browser: Browser, machine: Machine) -> None:
    session = record_session(1)
    assert session.recording is not None
    session.recording["episodes"] = []

    def assert_saved(page: Page, *expected: tuple[float, float, str | None]) -> None:
        expect(page.get_by_test_id("episodes-state")).to_have_attribute("data-state", "saved")
        assert session.recording is not None
        stored = [(each["start_s"], each["end_s"], each["outcome"]) for each in session.recording["episodes"]]
        assert stored == [(start, pytest.approx(end, abs=0.5), outcome) for start, end, outcome in expected]

    with opened(browser, machine, session) as page:
        expect(page.locator(ROW)).to_be_visible()
        page.get_by_test_id("rate-success").click()
        assert_saved(page, (0, 60, "success"))
        seek(page, "Shift+ArrowRight", "Shift+ArrowRight")
        page.get_by_test_id("split-episode").click()
        assert_saved(page, (0, 20, "success"), (20, 60, "success"))
        page.get_by_test_id("rate-failure").click()
        assert_saved(page, (0, 20, "success"), (20, 60, "failure"))
        end = page.get_by_test_id("episode-2-end")
        end.hover()  # the card of the episodes is further down
        box, bar = end.bounding_box(), page.get_by_test_id("session-bar").bounding_box()
        assert box is not None
        assert bar is not None
        page.mouse.down()
        page.mouse.move(bar["x"] + bar["width"] / 2, box["y"] + 6, steps=4)
        page.mouse.up()
        assert_saved(page, (0, 20, "success"), (20, 30, "failure"))
        page.get_by_label("Label").fill("Place the cup")
        page.get_by_label("Label").blur()
        expect(page.get_by_test_id("episode").nth(1)).to_contain_text("Place the cup")
        page.get_by_test_id("delete-episode").click()
        page.get_by_test_id("confirm-yes").click()
        expect(page.get_by_test_id("episode")).to_have_count(1)
        assert_saved(page, (0, 20, "success"))


def test_a_change_of_another_person_is_not_overwritten(browser: Browser, machine: Machine) -> None:
    session = record_session(1)
    assert session.recording is not None
    with opened(browser, machine, session) as page:
        expect(page.get_by_test_id("episode")).to_have_count(2)
        session.recording["episodes"] = [{"start_s": 1.0, "end_s": 9.0, "outcome": None, "label": "Other", "note": ""}]
        session.version += 1
        page.get_by_test_id("rate-failure").click()
        expect(page.get_by_test_id("episodes-state")).to_have_attribute("data-state", "conflict")
        expect(page.get_by_test_id("episode")).to_have_count(1)
        expect(page.get_by_test_id("episode")).to_contain_text("Other")
        assert [each["label"] for each in session.recording["episodes"]] == ["Other"]


def test_a_file_that_fails_is_named_and_loads_on_request(browser: Browser, machine: Machine) -> None:
    session = record_session(1)
    content = session.files[f"{EPOCH}-0.mcap"]
    session.files[f"{EPOCH}-0.mcap"] = content[:200]
    with opened(browser, machine, session) as page:
        expect(page.get_by_test_id("failed-segments")).to_contain_text("minute 1")
        assert_good_page(page, "session-failed")
        session.files[f"{EPOCH}-0.mcap"] = content
        page.get_by_test_id("failed-segments").get_by_role("button").click()
        expect(page.locator(ROW)).to_be_visible()
        expect(page.get_by_test_id("failed-segments")).to_have_count(0)


def test_a_deleted_recording_is_gone(browser: Browser, machine: Machine) -> None:
    session = record_session(1)
    with opened(browser, machine, session) as page:
        page.get_by_test_id("delete-recording").click()
        page.get_by_test_id("confirm-yes").click()
        expect(page.get_by_test_id("no-recording")).to_be_visible()
        assert session.recording is None
        assert_good_page(page, "session-none")
        page.get_by_role("link", name="All sessions of this robot").click()
        expect(page.locator(f"[data-testid=session][data-epoch='{EPOCH}']")).to_be_visible()
        expect(page.get_by_test_id("open-recording")).to_have_count(0)


def test_a_session_is_recorded_uploaded_shown_and_replayed_on_the_robot(browser: Browser, machine: Machine) -> None:
    with machine.api() as api, operator(browser, machine) as page:
        device = api.free_device()["id"]
        take_control(page)
        epoch = int(api.get(f"/devices/{device}/lease")["lease"]["epoch"])
        move_the_elbow(page, machine)
        expect(page.get_by_test_id("recording")).to_be_visible()
        release_control(page)
        expect(page.get_by_test_id("recording")).to_be_hidden()
        sessions = f"/devices/{device}/sessions"

        def recorded() -> list[int]:
            """Epochs of this test's sessions that are stored; a busy machine may have ended control in between."""
            items = api.get(sessions, limit=10)["items"]
            return [item["epoch"] for item in items if item["recorded"] and item["epoch"] >= epoch]

        wait_until(lambda: bool(recorded()), "the recording")
        shown = max(recorded(), key=lambda each: len(api.get(f"{sessions}/{each}")["recording"]["segments"]))
        page.evaluate("address => { location.hash = address; }", f"#/devices/{device}/sessions/{shown}")
        expect(page.locator(ROW)).to_be_visible()
        page.get_by_test_id("rate-success").click()
        expect(page.get_by_test_id("episode")).to_have_attribute("data-outcome", "success")
        name = f"replay_{shown}"
        page.get_by_test_id("replay-movement-name").fill(name)
        page.get_by_test_id("save-replay-movement").click()
        expect(page.get_by_test_id("replay-movement-saved")).to_be_visible()
        request = {"kind": "run_movement", "name": name, "parameters": {}}
        body = {"request": request, "wait_ms": 30_000, "wait_for": "done"}
        assert api.post(f"/devices/{device}/actions", body)["status"] == "done"
