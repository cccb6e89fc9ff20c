"""Short gaps pause motion and keep control, in Chromium; only a new press continues."""

import contextlib
import math
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.product import Machine
from tests.harness.browser.steering import (
    assert_at_rest,
    commanded_speed,
    drag,
    drive,
    elbow,
    in_control,
    open_robot,
    operator,
    release_control,
    reset_stop,
    take_control,
)
from tests.harness.network.brokers import wait_until

LOAD = 8
FULL_SIZE = 20
SAMPLE_SIZE = 3
BUSY_MS = 700
BLOCK = f"() => {{ const end = performance.now() + {BUSY_MS}; while (performance.now() < end); }}"
"""Occupies the page's only thread."""
_HOLD_S = 1.5
"""Duration of a drag; the arm moves most of the time."""


@contextlib.contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Run this many processes that never wait."""
    started = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def stream_state(page: Page) -> str:
    return page.get_by_test_id("stream-state").get_attribute("data-state") or ""


def lease_epoch(machine: Machine) -> int:
    with machine.api() as api:
        return int(api.device()["lease"]["epoch"])


def test_a_busy_browser_pauses_the_drag_until_the_next_press(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    with operator(browser, machine) as page:
        share = 0.75 if elbow(trace) < 0.5 else 0.25
        drive(page, share, lambda: commanded_speed(trace) > 0.2, "motion", release=False)
        epoch = lease_epoch(machine)
        page.evaluate(BLOCK)
        expect(page.get_by_test_id("stream-state")).to_have_attribute("data-state", "paused")
        expect(page.get_by_test_id("stream-state")).to_contain_text("ms (this browser was busy)")
        wait_until(lambda: commanded_speed(trace) == 0, "rest")
        box = page.get_by_test_id("slider-elbow").bounding_box()
        assert box is not None
        for step in range(10):  # the pointer is still pressed
            page.mouse.move(box["x"] + box["width"] * (0.3 + step / 25), box["y"] + box["height"] / 2)
        assert_at_rest(trace)
        assert math.degrees(elbow(trace)) == pytest.approx(
            float(page.get_by_test_id("slider-elbow").input_value()), abs=1
        )
        page.mouse.up()
        assert_at_rest(trace)
        assert in_control(page)
        rest = elbow(trace)
        drag(page, 0.25 if rest > 0.5 else 0.75)
        wait_until(lambda: abs(elbow(trace) - rest) > 0.1, "motion after a new press")
        page.mouse.up()
        assert in_control(page)
        assert lease_epoch(machine) == epoch
        release_control(page)


def test_a_repeated_key_does_not_continue_after_a_gap(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    with operator(browser, machine) as page:
        take_control(page)
        page.get_by_test_id("slider-elbow").focus()
        key = "ArrowLeft" if elbow(trace) > 0.5 else "ArrowRight"
        page.keyboard.down("Shift")  # larger steps
        page.keyboard.down(key)
        wait_until(lambda: commanded_speed(trace) > 0.1, "motion")
        page.evaluate(BLOCK)
        wait_until(lambda: stream_state(page) == "paused", "the pause")
        wait_until(lambda: commanded_speed(trace) == 0, "rest")
        for _ in range(5):
            page.keyboard.down(key)  # a repetition, because the key is still down
        assert_at_rest(trace)
        page.keyboard.up(key)
        rest = elbow(trace)

        def moved() -> bool:
            if not in_control(page):  # a busy machine may end control in the gap
                take_control(page)
                page.get_by_test_id("slider-elbow").focus()
            page.keyboard.press(key)
            return abs(elbow(trace) - rest) > 0.05

        wait_until(moved, "motion after a new press of the key")
        page.keyboard.up("Shift")
        assert in_control(page)
        release_control(page)


def drag_often(page: Page, machine: Machine, count: int) -> Counter[str]:
    """Drag the elbow this many times; control must remain, also when setpoints are late."""
    trace = machine.trace()
    outcomes = Counter[str]()
    take_control(page)
    epoch = lease_epoch(machine)
    for _ in range(count):
        before = elbow(trace)
        wait_until(page.get_by_test_id("slider-elbow").is_enabled, "the slider")
        drag(page, 0.35 if before > 0.5 else 0.65)
        until_s = time.monotonic() + _HOLD_S
        states = set()
        while time.monotonic() < until_s:
            states.add(stream_state(page))
            page.wait_for_timeout(50)
        page.mouse.up()
        outcomes["paused" if "paused" in states else "continuous"] += 1
        outcomes["moved"] += abs(elbow(trace) - before) > 0.05
        outcomes["kept"] += in_control(page) and lease_epoch(machine) == epoch
    release_control(page)
    return outcomes


def test_slider_drags_keep_control(browser: Browser, machine: Machine) -> None:
    with operator(browser, machine) as page:
        outcomes = drag_often(page, machine, SAMPLE_SIZE)
    assert outcomes["kept"] == SAMPLE_SIZE, outcomes


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_slider_drags_keep_control_on_a_loaded_machine(browser: Browser, machine: Machine) -> None:
    with operator(browser, machine) as page:
        take_control(page)
        with busy_processes(LOAD):
            outcomes = drag_often(page, machine, FULL_SIZE)
    sys.stdout.write(f"{outcomes}\n")
    assert outcomes["kept"] == FULL_SIZE, outcomes


def test_the_actual_cause_of_a_loss_is_shown(browser: Browser, machine: Machine) -> None:
    with operator(browser, machine) as page, machine.api() as api:
        take_control(page)
        api.post(f"/devices/{api.device()['id']}/stop", {})
        expect(page.get_by_test_id("control-state")).to_contain_text("Control lost: stopped by demo")
        reset_stop(page)


def test_the_own_action_is_named_in_all_tabs(browser: Browser, machine: Machine) -> None:
    with pages(browser, machine, 2) as (page, other):
        open_robot(page)
        open_robot(other)
        page.get_by_test_id("movement-wave").click()
        for each in (page, other):
            expect(each.get_by_test_id("control-state")).to_have_text("You are running wave")
        page.get_by_test_id("cancel-action").click()
        for each in (page, other):
            expect(each.get_by_test_id("control-state")).not_to_have_attribute("data-state", "running")
