"""An operator at the page of the arm, and the simulation's record of the motion."""

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, BrowserContext, Error, Page, expect

from tests.harness.browser.browser import PATIENCE_MS
from tests.harness.browser.product import Machine, Trace
from tests.harness.network.brokers import PATIENCE_S, wait_until

STOP_WITHIN_MS = 350
_TRIES = 5
"""A busy machine may pause the robot's process."""


@contextlib.contextmanager
def operator(browser: Browser, machine: Machine) -> Iterator[Page]:
    """A person with a browser of their own, signed in, looking at the robot. Fails on any script error."""
    context: BrowserContext = browser.new_context(viewport={"width": 1440, "height": 900})
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if "Content Security" in message.text else None)
    page.goto(machine.sign_in_link())
    expect(page.get_by_test_id("signed-in")).to_be_visible(timeout=PATIENCE_MS)
    assert "sign-in=" not in page.url
    page.get_by_test_id("device-row").filter(has_text="UR5").get_by_role("link").first.click()
    expect(page.get_by_test_id("control-state")).to_be_visible(timeout=PATIENCE_MS)
    try:
        yield page
    finally:
        with contextlib.suppress(Error):  # a browser that a test has killed is closed already
            context.close()
    assert errors == []


def elbow(trace: Trace) -> float:
    """Measured by the simulation [rad]."""
    return float(trace.now()["qpos"]["elbow"])


def shown(page: Page, joint: str = "elbow") -> float:
    """Measured, as the page shows it [deg]."""
    return float(page.get_by_test_id(f"measured-{joint}").get_attribute("data-value") or "nan")


def take(page: Page) -> None:
    """Take control; where the lease of a browser that died is still running, wait for its end."""
    state = page.get_by_test_id("control-state")
    deadline_s = time.monotonic() + 2 * PATIENCE_S
    while state.get_attribute("data-state") != "mine":
        assert time.monotonic() < deadline_s, state.text_content()
        button = page.get_by_test_id("take-control")
        if button.count():
            with contextlib.suppress(Error):  # it disappears when an operator has control
                button.click(timeout=1_000)
        page.wait_for_timeout(300)
    expect(page.get_by_test_id("slider-elbow")).to_be_enabled()


def release(page: Page) -> None:
    """Give control up, where the robot has not ended it: on a busy machine setpoints come late, and it holds."""
    for _ in range(30):
        if page.get_by_test_id("control-state").get_attribute("data-state") != "mine":
            return
        with contextlib.suppress(Error):  # gone between the look and the click
            page.get_by_test_id("release-control").click(timeout=1000)
            return
    pytest.fail("control is still held, and cannot be given up")


def drag(page: Page, share: float, joint: str = "elbow", *, let_go: bool = True) -> None:
    """Drag the slider with the mouse to a share of its width."""
    slider = page.get_by_test_id(f"slider-{joint}")
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    value, low, high = (
        float(slider.evaluate(f"e => e.{name}") if name == "valueAsNumber" else slider.get_attribute(name) or "nan")
        for name in ("valueAsNumber", "min", "max")
    )
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] * (value - low) / (high - low), y)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * share, y, steps=5)
    if let_go:
        page.mouse.up()


def drive(page: Page, share: float, there: Callable[[], bool], what: str, *, let_go: bool = True) -> None:
    """Take control and drag the elbow until ``there``.

    On a machine so busy that setpoints come late, the robot holds and ends the control, as it must: take it again.
    """
    for _ in range(20):
        if page.get_by_test_id("control-state").get_attribute("data-state") != "mine":
            page.mouse.up()
            take(page)
        drag(page, share, let_go=let_go)
        for _ in range(50):
            if there():
                return
            if page.get_by_test_id("control-state").get_attribute("data-state") != "mine":
                break
            page.wait_for_timeout(100)
    pytest.fail(f"{what} never happened")


def end_in_mid_motion(page: Page, trace: Trace, end: Callable[[], None]) -> float:
    """Take control, drag, end something while the arm moves; how long the arm was commanded to move after that [ms]."""
    share = 0.75 if elbow(trace) < 0.5 else 0.25
    drive(page, share, lambda: commanded_speed(trace) > 0.2, "motion", let_go=False)
    end()
    ended_ms = time.time() * 1000
    wait_until(lambda: commanded_speed(trace) == 0, "rest")
    moving = [row["at_ms"] for row in speeds(trace) if row["speed"] > 1e-3]
    rest = elbow(trace)
    time.sleep(1)
    assert abs(elbow(trace) - rest) < 0.005
    return max(moving) - ended_ms


def stopped_in_time(attempt: Callable[[], float]) -> bool:
    """Whether the arm stands still in time in one of some attempts."""
    return any(attempt() < STOP_WITHIN_MS for _ in range(_TRIES))


def speeds(trace: Trace, newest: int = 800) -> list[dict[str, float]]:
    """Commanded speed of the fastest joint between rows of the trace [rad/s]."""
    rows = trace.rows(newest)
    found = []
    for before, after in itertools.pairwise(rows):
        step_s = after["time_s"] - before["time_s"]
        fastest = max(abs(after["target"][name] - before["target"][name]) for name in after["target"])
        found.append({"at_ms": after["at_ms"], "speed": fastest / step_s if step_s else 0.0})
    return found


def commanded_speed(trace: Trace) -> float:
    """The most in the last 0.15 s: a control loop that a busy machine held up for some periods is not at rest."""
    return max((row["speed"] for row in speeds(trace, 20)[-15:]), default=0.0)
