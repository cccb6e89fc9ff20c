"""The broker dies under an operator whose robot moves: that holds, and the page says so and comes back as it was."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.harness.agent.arm import drive, elbow, end_in_mid_motion, operator, release, stopped_in_time
from tests.harness.browser.product import Api, Machine, start_machine
from tests.harness.network.brokers import BROKERS, wait_until

NOTE = """() => {
    window.saidOfTheLink = [];
    const look = () => {
        const banner = document.querySelector("[data-testid=link-banner]");
        if (banner !== null) window.saidOfTheLink.push(banner.textContent);
    };
    new MutationObserver(look).observe(document.body, {subtree: true, childList: true, characterData: true});
}"""
"""Keeps all that is said of the link, however short a time: the broker may be back before a test looks."""
TYPED = "0.123"


@pytest.fixture(params=BROKERS)
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Machine, str]]:
    """The product, and what its broker's program is called."""
    if request.param == "amqtt":
        yield request.getfixturevalue("machine"), "infra.embedded_broker"
        return
    with start_machine(tmp_path, TELESCOPE_BROKER=request.param) as machine:
        yield machine, f"infra.{request.param}"


def kill(machine: Machine, program: str) -> None:
    """The broker, with what runs below it."""
    os.killpg(machine.pid(program), signal.SIGKILL)


def in_control(page: Page, api: Api, device: str) -> list[bool]:
    """Whether an operator has control according to the page, the cloud and the robot."""
    cloud = api.get(f"/devices/{device}")
    shown = page.get_by_test_id("control-state").get_attribute("data-state")
    return [shown == "mine", cloud["lease"] is not None, cloud["state"]["lease"] is not None]


def test_a_broker_that_dies_in_mid_motion_costs_that_motion_and_nothing_else(
    browser: Browser, site: tuple[Machine, str]
) -> None:
    machine, program = site
    trace = machine.trace()
    with machine.api() as api, operator(browser, machine) as page:
        device = api.device()["id"]
        expect(page.get_by_test_id("pose-2")).not_to_have_value("")
        page.get_by_test_id("pose-2").fill(TYPED)
        page.evaluate(NOTE)

        def attempt() -> float:
            moved_on_ms = end_in_mid_motion(page, trace, lambda: kill(machine, program))
            page.mouse.up()
            expect(page.get_by_test_id("online")).to_have_attribute("data-status", "online")
            expect(page.get_by_test_id("link-banner")).to_have_count(0)
            return moved_on_ms

        assert stopped_in_time(attempt)
        assert any("No connection to the broker" in said for said in page.evaluate("() => window.saidOfTheLink"))

        # The robot had to hold, which ended control: page, cloud and robot say the same.
        wait_until(lambda: not any(in_control(page, api, device)), "one account of who has control")
        expect(page.get_by_test_id("slider-elbow")).to_be_disabled()

        rest = elbow(trace)
        share = 0.75 if rest < 0.5 else 0.25
        drive(page, share, lambda: abs(elbow(trace) - rest) > 0.1, "the elbow following the slider again")
        wait_until(lambda: len(set(in_control(page, api, device))) == 1, "one account of who has control")
        assert page.get_by_test_id("pose-2").input_value() == TYPED
        release(page)
