"""Two users with one arm in two browsers: control handover and the list of viewers."""

import contextlib
import json
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from tests.harness.browser.browser import PATIENCE_MS, person
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.browser.steering import move_the_elbow, open_robot, release_control, take_control
from tests.harness.network.brokers import wait_until

SILENCE_MS = 12_000
STATE_MS = 5_000


@pytest.fixture
def two(browser: Browser, machine: Machine) -> Iterator[tuple[Page, Page]]:
    """Pages of the owner (Demo) and an operator (Carol), both on the arm's page."""
    with machine.api("carol") as carol, machine.api() as owner:
        device = owner.device()["id"]
        account = carol.get("/accounts/me")["id"]
        owner.post(f"/devices/{device}/shares", {"account": "carol", "role": "operator"})
        with (
            person(browser, machine.sign_in_link()) as demo_page,
            person(browser, machine.sign_in_link("carol")) as carol_page,
        ):
            for page in (demo_page, carol_page):
                open_robot(page)
            yield demo_page, carol_page
        owner.http.delete(f"/devices/{device}/shares/{account}").raise_for_status()


def expect_state(page: Page, state: str) -> None:
    expect(page.get_by_test_id("control-state")).to_have_attribute("data-state", state)


def request_control(requester: Page, holder: Page) -> None:
    take_control(holder)
    requester.get_by_test_id("request-control").click()
    expect(holder.get_by_test_id("incoming-request")).to_contain_text("requests control")
    expect(requester.get_by_test_id("control-request")).to_contain_text("You requested control from demo")


def take_over(owner: Page, holder: Page) -> bool:
    """Whether the holder sees the reason. On a busy machine the robot may end the holder's control first."""
    release_control(owner)
    take_control(holder)
    owner.get_by_test_id("take-over").click()
    owner.get_by_test_id("take-over-reason").fill("the arm is needed here")
    assert_good_page(owner, "taking-over")
    owner.get_by_test_id("take-over-reason").press("Enter")
    expect_state(owner, "mine")
    expect_state(holder, "lost")
    # The reason follows with the robot's next state message.
    with contextlib.suppress(AssertionError):
        expect(holder.get_by_test_id("control-state")).to_contain_text("the arm is needed here", timeout=STATE_MS)
        return True
    return False


def test_control_is_handed_over_and_viewers_are_listed(two: tuple[Page, Page], machine: Machine) -> None:
    demo, carol = two
    # Each page lists the other viewer.
    for page, name in ((demo, "carol"), (carol, "demo")):
        button = page.get_by_test_id("watchers")
        expect(button).to_be_visible()
        button.click()
        expect(page.get_by_test_id("watcher-names")).to_contain_text(name)
    assert_good_page(demo, "watchers")
    demo.get_by_test_id("watchers").press("Enter")

    # Requested and rejected, by keyboard.
    request_control(carol, demo)
    assert_good_page(demo, "asked-for-control")
    assert_good_page(carol, "asking-for-control")
    demo.get_by_test_id("refuse-request").press("Enter")
    expect(carol.get_by_test_id("control-request")).to_contain_text("demo keeps control")
    expect(demo.get_by_test_id("request-response")).to_contain_text("You keep control")

    # Requested and withdrawn.
    request_control(carol, demo)
    carol.get_by_test_id("withdraw-request").press("Enter")
    expect(demo.get_by_test_id("accept-request")).to_have_count(0)
    expect(carol.get_by_test_id("control-request")).to_contain_text("You withdrew your request")

    # Requested and granted: the former holder's sliders are disabled, the new holder's move the arm.
    request_control(carol, demo)
    demo.get_by_test_id("accept-request").press("Enter")
    expect_state(demo, "handed")
    expect(demo.get_by_test_id("slider-elbow")).to_be_disabled()
    expect_state(carol, "mine")
    expect(carol.get_by_test_id("control-request")).to_contain_text("demo handed control over to you")
    move_the_elbow(carol, machine)
    expect(demo.get_by_test_id("slider-elbow")).to_be_disabled()

    # The owner takes control; Carol cannot and sees the reason.
    take_control(carol)
    expect(carol.get_by_test_id("take-over")).to_have_count(0)
    wait_until(lambda: take_over(demo, carol), "Carol to see who took control and why")
    expect(carol.get_by_test_id("slider-elbow")).to_be_disabled()
    demo.get_by_test_id("release-control").click()
    expect_state(demo, "free")
    # A viewer who leaves is removed from the list.
    carol.goto("about:blank")
    expect(demo.get_by_test_id("watchers")).to_have_count(0, timeout=2 * PATIENCE_MS)


def shorten_timeout(route: Route) -> None:
    """The holder has 30 s to answer; this test uses less."""
    body: dict[str, Any] = route.request.post_data_json or {}
    route.continue_(post_data=json.dumps(body | {"within_ms": SILENCE_MS}))


def test_an_unanswered_request_does_not_take_control(two: tuple[Page, Page]) -> None:
    demo, carol = two
    carol.route("**/lease/requests", shorten_timeout)
    request_control(carol, demo)
    expect(carol.get_by_test_id("control-request")).to_contain_text("did not respond in time")
    expect(demo.get_by_test_id("accept-request")).to_have_count(0)
    demo.get_by_test_id("release-control").click()


def test_the_device_list_shows_the_short_id_of_the_operator(two: tuple[Page, Page], machine: Machine) -> None:
    demo, carol = two
    take_control(carol)
    with machine.api("carol") as api:
        short_id = f"#{api.get('/accounts/me')['id'][:6]}"
    demo.goto(f"{machine.url}/#/")
    row = demo.locator("[data-testid=device-row][data-device$='-ur5']")
    expect(row).to_contain_text(f"carol {short_id}")
    assert_good_page(demo, "device-list-operator")
    release_control(carol)
