"""Ten robots on one page: each shows its own values, and memory use stays bounded."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from benchmarks.console.frames import ROBOTS, memory_samples, open_together
from benchmarks.console.kinematic_arms import start_kinematic_arms
from benchmarks.console.minimal_agents import pair_minimal_agents
from tests.harness.browser.browser import pages
from tests.harness.browser.product import Machine, start_machine
from tests.harness.network.brokers import wait_until

DISPLAY_MS = 8_000
MAX_GROWTH = 1.5
"""Maximum growth factor of the memory; the buffers of 20 s of telemetry still fill."""
PANS = (
    """() => [...document.querySelectorAll("[data-testid=measured-shoulder_pan]")].map((each) => each.dataset.value)"""
)


@pytest.fixture
def own_machine(tmp_path: Path) -> Iterator[Machine]:
    """A product for this test, which adds robots."""
    with start_machine(tmp_path / "machine") as machine:
        yield machine


def pans(page: Page) -> list[str]:
    texts: list[str] = page.evaluate(PANS)
    return texts


def check_silent_robot_shows_no_values(page: Page, machine: Machine, silent: str, arm: str) -> None:
    page.goto(f"{machine.url}/#/operate/{silent},{arm}")
    station = page.locator(f"[data-testid=robot-panel][data-device='{silent}']")
    expect(station).to_be_visible()
    wait_until(lambda: len(pans(page)) == 1 and pans(page)[0] != "", "the joints of the other robot")
    expect(station.get_by_test_id("view-3d")).to_have_attribute("data-frames", "0")
    expect(station.locator(".joint")).to_have_count(0)


def test_ten_robots_show_their_own_values_in_bounded_memory(own_machine: Machine, drawing_browser: Browser) -> None:
    with (
        pair_minimal_agents(own_machine, 1) as (silent,),
        start_kinematic_arms(own_machine, ROBOTS) as ids,
        pages(drawing_browser, own_machine) as (page,),
    ):
        open_together(page, own_machine, ids)
        wait_until(lambda: len(pans(page)) == ROBOTS and "" not in pans(page), "the joints of each robot")
        session = page.context.new_cdp_session(page)
        before, at = memory_samples(session), pans(page)
        wait_until(
            lambda: all(now != earlier for now, earlier in zip(pans(page), at, strict=True)), "each robot to move"
        )
        page.wait_for_timeout(DISPLAY_MS)
        after = memory_samples(session)
        assert after.heap_mb < MAX_GROWTH * before.heap_mb, f"{before}, then {after}"
        assert after.nodes < MAX_GROWTH * before.nodes, f"{before}, then {after}"
        assert after.listeners < MAX_GROWTH * before.listeners, f"{before}, then {after}"
        check_silent_robot_shows_no_values(page, own_machine, silent.device, ids[0])
