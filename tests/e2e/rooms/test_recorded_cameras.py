"""The owner allows a robot's camera to be recorded; the room shows it, and the session's page shows the pictures."""

from typing import Any

import pytest
from playwright.sync_api import Browser, Locator, expect

from device_agent.protocol import camera_frames, topics
from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Api, Machine, mqtt_client
from tests.harness.browser.steering import open_robot
from tests.harness.network.brokers import wait_until

DRAWN = """canvas => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height)
    .data.some(value => value > 0)"""
EYES = "/frames/eyes"


def wait_in_session(api: Api, path: str, shown: Locator) -> None:
    """Wait until this is shown in a session of the robot. A busy machine may end its lease; then take another one."""

    def found() -> bool:
        if not shown.count() and api.get(path)["state"]["lease"] is None:
            api.http.post(f"{path}/lease", json={"lease_ms": 600_000, "wait_ms": 10_000})
        return shown.count() > 0

    wait_until(found, str(shown))


def wait_for_frames(api: Api, device: dict[str, Any], count: int) -> None:
    """Wait for frames that viewers receive during control: those that are due are also recorded."""
    with mqtt_client(api, purpose="view") as (client, issued):
        cameras = [each for each in issued["subscribe"] if f"/{device['name']}/{topics.CAM}/" in each]
        assert client.subscribe(*cameras, qos=0)
        ticks = set[int]()

        def received() -> bool:
            ticks.update(camera_frames.decode(message.payload).tick_ms for message in client.pending())
            return len(ticks) >= count

        wait_until(received, f"{count} frames")


def recorded_session(api: Api, path: str) -> int:
    """Epoch of a stored session with frames; 0 if there is none yet."""
    epochs = [each["epoch"] for each in api.get(f"{path}/sessions", limit=20)["items"] if each["recorded"]]
    return next((each for each in epochs if EYES in api.get(f"{path}/sessions/{each}")["recording"]["cameras"]), 0)


@pytest.mark.sampled
def test_a_camera_is_recorded_with_consent_and_shown_in_its_room_and_session(
    browser: Browser, laboratory: Machine
) -> None:
    with laboratory.api() as api, pages(browser, laboratory) as (page,):
        device = api.free_device("qbo")
        path = f"/devices/{device['id']}"
        open_robot(page, device["label"])
        eyes = page.locator("[data-testid=camera-consent] [data-camera=eyes]")
        expect(eyes).to_have_attribute("data-allowed", "false")
        page.get_by_test_id("give-consent").click()
        page.get_by_test_id("confirm-yes").click()
        expect(eyes).to_have_attribute("data-allowed", "true")
        assert_good_page(page, "camera-consent", part="camera-consent")

        chip = page.locator("[data-testid=recording][data-cameras=eyes]")
        wait_in_session(api, path, chip)
        wait_for_frames(api, device, 4)
        page.evaluate("address => { location.hash = address; }", f"#/spaces/{device['space']}")
        notice = page.get_by_test_id("recorded-cameras")
        wait_in_session(api, path, notice.filter(has_text=f"{device['label']} (eyes)"))
        page.go_back()
        page.get_by_test_id("withdraw-consent").click()
        expect(eyes).to_have_attribute("data-allowed", "false")
        expect(chip).to_have_count(0)
        lease = api.get(f"{path}/lease")["lease"]
        api.http.delete(f"{path}/lease?epoch={1 if lease is None else lease['epoch']}")

        wait_until(lambda: recorded_session(api, path), "a recording with frames")
        page.evaluate("address => { location.hash = address; }", f"#{path}/sessions/{recorded_session(api, path)}")
        image = page.locator(f"[data-topic='{EYES}'] canvas")
        cursor = page.get_by_test_id("session-cursor")

        def drawn() -> bool:
            cursor.press("ArrowRight")
            return image.is_visible() and image.evaluate(DRAWN) is True

        wait_until(drawn, "a recorded picture")
        assert_good_page(page, "session-camera")
