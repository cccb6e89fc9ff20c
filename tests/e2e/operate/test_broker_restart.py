"""After a broker failure the moving robot holds, and the page reports it and recovers its state."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.product import Api, Machine, start_machine
from tests.harness.browser.steering import (
    drive,
    elbow,
    end_in_mid_motion,
    in_control,
    operator,
    release_control,
    stopped_in_time,
)
from tests.harness.network.brokers import BROKERS, MODULES, wait_until

NOTE = """() => {
    window.bannerTexts = [];
    const record = () => {
        const banner = document.querySelector("[data-testid=link-banner]");
        if (banner !== null) window.bannerTexts.push(banner.textContent);
    };
    new MutationObserver(record).observe(document.body, {subtree: true, childList: true, characterData: true});
}"""
"""Records every text of the link banner, because the broker may recover before the test reads it."""
TYPED = "0.123"


@pytest.fixture(params=BROKERS)
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Machine, str]]:
    """The product and the name of its broker program."""
    if request.param == "amqtt":
        yield request.getfixturevalue("machine"), "infra.embedded_broker"
        return
    with start_machine(tmp_path, TELESCOPE_BROKER=request.param) as machine:
        yield machine, MODULES[request.param]


def kill(machine: Machine, program: str) -> None:
    """Kill the broker and its child processes."""
    os.killpg(machine.pid(program), signal.SIGKILL)


def control_views(page: Page, api: Api, device: str) -> list[bool]:
    """Whether an operator has control according to the page, the cloud and the robot."""
    cloud = api.get(f"/devices/{device}")
    displayed = page.get_by_test_id("control-state").get_attribute("data-state")
    return [displayed == "mine", cloud["lease"] is not None, cloud["state"]["lease"] is not None]


def test_a_broker_failure_ends_only_the_running_motion(browser: Browser, site: tuple[Machine, str]) -> None:
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
        assert any("No connection to the broker" in text for text in page.evaluate("() => window.bannerTexts"))

        # The robot held, which ended control, unless it was at rest at that moment. Page, cloud and robot agree.
        wait_until(lambda: len(set(control_views(page, api, device))) == 1, "page, cloud and robot to agree on control")
        if not in_control(page):
            expect(page.get_by_test_id("slider-elbow")).to_be_disabled()

        rest = elbow(trace)
        share = 0.75 if rest < 0.5 else 0.25
        drive(page, share, lambda: abs(elbow(trace) - rest) > 0.1, "the elbow following the slider again")
        wait_until(lambda: len(set(control_views(page, api, device))) == 1, "page, cloud and robot to agree on control")
        assert page.get_by_test_id("pose-2").input_value() == TYPED
        release_control(page)
