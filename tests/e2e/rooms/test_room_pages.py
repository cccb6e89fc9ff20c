"""Pages of the laboratory in Chromium: plan, camera and lamp."""

import math

from playwright.sync_api import Browser, Page, expect

from device_agent.protocol.manifests import room as rooms
from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

ROBOTS = ("ur5", "nao", "qbo", "hanson")
FIXED = ("ur5", "hanson")


def place(page: Page, who: str) -> tuple[float, float]:
    """Position of a robot on the plan [m]."""
    mark = page.get_by_test_id(f"place-{who}")
    expect(mark).to_be_visible()
    x_m, y_m = (float(mark.get_attribute(f"data-{axis}") or "nan") for axis in "xy")
    return x_m, y_m


def picture(page: Page) -> str:
    """Current pixels of the canvas."""
    pixels: str = page.get_by_test_id("camera-picture").evaluate("canvas => canvas.toDataURL()")
    return pixels


def no_new_frame(page: Page) -> bool:
    canvas = page.get_by_test_id("camera-picture")
    last = canvas.get_attribute("data-sequence")
    page.wait_for_timeout(700)
    return canvas.get_attribute("data-sequence") == last


def lux(page: Page) -> float:
    return float(page.get_by_test_id("value-light_lux").get_attribute("data-value") or "nan")


def open_device(page: Page, name: str) -> None:
    page.get_by_test_id("device-row").filter(has_text=name).get_by_role("link").first.click()
    expect(page.locator(".desk.room")).to_be_visible()


def test_plan_camera_and_lamp_of_the_room(browser: Browser, laboratory: Machine) -> None:
    room = rooms.load(ROOT / "robots" / "rooms" / "lab")
    with pages(browser, laboratory, 2) as (ann, bob):
        # The plan shows the four robots at their measured positions, mounted ones at their bases.
        ann.get_by_test_id("plan-link").click()
        for name in ROBOTS:
            x_m, y_m = place(ann, name)
            assert room.plan.lower_m[0] < x_m < room.plan.upper_m[0], name
            assert room.plan.lower_m[1] < y_m < room.plan.upper_m[1], name
            robot = room.robot(name)
            assert robot is not None
            assert name not in FIXED or math.dist((x_m, y_m), robot.position_m[:2]) < 0.3, (name, x_m, y_m)
        wait_until(lambda: bool(ann.get_by_test_id("plan").get_attribute("data-floor")), "the floor")

        assert_good_page(ann, "plan")

        # A pin opens the page of its device.
        ann.get_by_test_id("plan").get_by_role("link", name="Corner camera").click()
        ann.get_by_test_id("camera-live").click()
        canvas = ann.get_by_test_id("camera-picture")
        wait_until(lambda: canvas.get_attribute("data-sequence") is not None, "a picture")
        first = picture(ann)
        wait_until(lambda: picture(ann) != first, "another picture")
        ann.get_by_test_id("camera-live").click()
        expect(ann.get_by_test_id("camera-live")).to_have_attribute("aria-pressed", "false")
        wait_until(lambda: no_new_frame(ann), "the stream to end without a viewer")

        # One page collects light values, the other switches the lamp.
        open_light(bob)
        ann.goto(f"{laboratory.url}/#/")
        open_device(ann, "Ceiling lamps")
        before = lux(bob)
        ann.get_by_test_id("level-most").click()
        wait_until(lambda: lux(bob) > before + 20, f"more light than {before} lx")
        ann.get_by_test_id("level-least").click()
        expect(ann.get_by_test_id("applied-level")).to_have_attribute("data-value", "0")
        wait_until(lambda: lux(bob) < before - 100, f"less light than {before} lx")
        assert_good_page(bob, "light")
        bob.get_by_test_id("gather").click()
        expect(bob.get_by_test_id("gather-state")).to_have_attribute("data-running", "false")

        # A device without joints has no autonomy.
        expect(bob.get_by_test_id("to-autonomy")).to_have_count(0)
        bob.evaluate("() => { location.hash += '/autonomy'; }")
        expect(bob.get_by_test_id("no-autonomy")).to_be_visible()
        expect(bob.get_by_role("link", name="Autonomy", exact=True)).to_have_count(0)

        # Restore the state for other tests, by keyboard.
        slider = ann.get_by_test_id("set-level")
        slider.focus()
        for _ in range(7):
            ann.keyboard.press("PageUp")
        wait_until(lambda: applied(ann) > 0.5, "the lamp to be on again")


def applied(page: Page) -> float:
    return float(page.get_by_test_id("applied-level").get_attribute("data-value") or "nan")


def open_light(page: Page) -> None:
    """Open the light meter's page and collect at 5 Hz."""
    page.get_by_test_id("search").fill("light meter")
    expect(page.get_by_test_id("device-row")).to_have_count(1)
    open_device(page, "Light")
    page.get_by_test_id("gather-rate").fill("5")
    page.get_by_test_id("gather").click()
    expect(page.get_by_test_id("gather-state")).to_have_attribute("data-running", "true")
    wait_until(lambda: lux(page) > 0, "light")
