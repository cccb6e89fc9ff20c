"""Depth images, lidar scans and tracked people of the laboratory, live in Chromium."""

import re

from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import wait_until

BEAMS = 360
ROUND_S = 180.0
"""Longer than one round of the person on a busy machine."""


def sequence(page: Page, canvas: str) -> int:
    """Sequence of the frame on a canvas; 0 before the first."""
    return int(page.get_by_test_id(canvas).get_attribute("data-sequence") or 0)


def number(page: Page, element: str, name: str) -> int:
    return int(page.get_by_test_id(element).get_attribute(f"data-{name}") or 0)


def open_device(page: Page, machine: Machine, name: str) -> None:
    page.goto(f"{machine.url}/#/")
    page.get_by_test_id("device-row").filter(has_text=name).get_by_role("link").first.click()
    expect(page.locator(".desk.room")).to_be_visible()


def sent_to_broker(page: Page) -> list[bytes]:
    """What the page sends on its WebSocket connections. Reloads the page, so that it connects again."""
    sent: list[bytes] = []

    def note(payload: bytes | str) -> None:
        sent.append(payload if isinstance(payload, bytes) else payload.encode())

    page.on("websocket", lambda socket: socket.on("framesent", note))
    page.reload()
    expect(page.get_by_test_id("signed-in")).to_be_visible()
    return sent


def unsubscribed(page: Page, sent: list[bytes]) -> bool:
    page.wait_for_timeout(50)  # Delivers the events of the page.
    return all(topic in b"".join(sent) for topic in (b"cam/depth", b"cam/people"))


def test_depth_skeletons_and_scans_are_live(browser: Browser, laboratory: Machine) -> None:
    with pages(browser, laboratory) as (page,):
        sent = sent_to_broker(page)
        open_device(page, laboratory, "Depth camera above the whiteboard")
        page.get_by_test_id("depth-live").click()
        expect(page.get_by_test_id("depth-picture")).to_be_visible()
        first = sequence(page, "depth-picture")
        wait_until(lambda: sequence(page, "depth-picture") > first, "another depth image")
        page.get_by_test_id("depth-picture").hover()
        expect(page.get_by_test_id("depth-value")).to_have_text(re.compile(r"\d\.\d\d m"))

        skeletons = page.locator("[data-testid^=skeleton-]")
        wait_until(lambda: skeletons.count() > 0, "a skeleton", ROUND_S)
        assert int(skeletons.first.get_attribute("data-joints") or 0) > 10
        expect(page.get_by_test_id("tracked-people")).to_have_text(re.compile("1 person is tracked"))
        assert_good_page(page, "depth")
        assert b"cam/depth" in b"".join(sent), "the page did not subscribe"
        sent.clear()
        page.get_by_test_id("depth-live").click()
        # Only the end of a subscription names the topic again.
        wait_until(lambda: unsubscribed(page, sent), "the end of both subscriptions")

        open_device(page, laboratory, "Lidar below the window")
        wait_until(lambda: number(page, "scan", "beams") == BEAMS, "a live scan")
        first = sequence(page, "scan")
        wait_until(lambda: sequence(page, "scan") > first, "another scan")
        page.get_by_test_id("scan-shot").click()
        expect(page.get_by_test_id("scan-live")).to_be_visible()
        page.get_by_test_id("scan-live").click()
        wait_until(lambda: sequence(page, "scan") > first, "the live scan again")
        assert_good_page(page, "lidar")

        page.goto(f"{laboratory.url}/#/")
        page.get_by_test_id("plan-link").click()
        wait_until(lambda: number(page, "plan", "echoes") > BEAMS / 2, "echoes on the plan")
        wait_until(lambda: number(page, "plan", "people") == 1, "a person on the plan", ROUND_S)
        assert_good_page(page, "plan")
