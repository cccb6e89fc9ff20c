"""The console benchmark measures each phase of a button press in order."""

from itertools import pairwise

from playwright.sync_api import Browser

from benchmarks.console import slider
from tests.harness.browser.browser import pages
from tests.harness.browser.product import Machine

CLOCKS_AGREE_MS = 15.0
"""Tolerance between clocks [ms]: the trace has 10 ms resolution, and two processes read wall clocks."""


def test_every_part_of_a_press_is_measured_and_in_order(drawing_browser: Browser, machine: Machine) -> None:
    with pages(drawing_browser, machine) as (page,):
        presses = slider.measure(page, machine, 2)
        for _ in range(5):  # a busy machine may render none of six presses in time
            presses = presses or slider.presses(page, machine, 2)
        if page.get_by_test_id("release-control").count():
            page.get_by_test_id("release-control").click()
    assert presses, "no press was rendered in time"
    for press in presses:
        assert tuple(press.at_ms) == slider.PARTS
        times = list(press.at_ms.values())
        assert times[0] >= 0
        assert all(after > before - CLOCKS_AGREE_MS for before, after in pairwise(times)), press
    slider.show(presses)
