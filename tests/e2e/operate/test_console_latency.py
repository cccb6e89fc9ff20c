"""The benchmark of the console measures what it says: every part of a press, in its order."""

from itertools import pairwise

from playwright.sync_api import Browser

from benchmarks.console import slider
from tests.harness.browser.browser import pages
from tests.harness.browser.product import Machine

CLOCKS_AGREE_MS = 15.0
"""The simulation's record has a line each 10 ms, and the wall clocks of two programs are read in between."""


def test_every_part_of_a_press_is_measured_and_in_order(drawing_browser: Browser, machine: Machine) -> None:
    with pages(drawing_browser, machine) as (page,):
        found = slider.measure(page, machine, 2)
        for _ in range(5):  # a busy machine may draw none of six in time
            found = found or slider.presses(page, machine, 2)
        if page.get_by_test_id("release-control").count():
            page.get_by_test_id("release-control").click()
    assert found, "not one press was drawn in time"
    for press in found:
        assert tuple(press.at_ms) == slider.PARTS
        times = list(press.at_ms.values())
        assert times[0] >= 0
        assert all(after > before - CLOCKS_AGREE_MS for before, after in pairwise(times)), press
    slider.show(found)
