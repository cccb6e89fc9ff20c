"""An operator at the page of a robot, and the simulation's record of the motion."""

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, Error, Locator, Page, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.product import Machine, Trace
from tests.harness.network.brokers import wait_until

STOP_WITHIN_MS = 350
_ATTEMPTS = 5
"""A busy machine may pause the robot's process."""


@contextlib.contextmanager
def operator(browser: Browser, machine: Machine, robot: str = "UR5") -> Iterator[Page]:
    """A signed-in user on a robot's page."""
    with pages(browser, machine) as (page,):
        assert "sign-in=" not in page.url
        open_robot(page, robot)
        yield page


def open_robot(page: Page, robot: str = "UR5") -> None:
    """Open a robot's page from the device list."""
    # By its link: the row of another robot may contain the name in its type.
    page.get_by_test_id("device-row").get_by_role("link", name=robot).first.click()
    expect(page.get_by_test_id("control-state")).to_be_visible()


def elbow(trace: Trace) -> float:
    """Measured position in the simulation [rad]."""
    return float(trace.now()["qpos"]["elbow"])


def shown(page: Page, joint: str = "elbow") -> float:
    """Measured position on the page [deg]."""
    return float(page.get_by_test_id(f"measured-{joint}").get_attribute("data-value") or "nan")


def in_control(panel: Page | Locator) -> bool:
    return panel.get_by_test_id("control-state").get_attribute("data-state") == "mine"


def take_control(panel: Page | Locator) -> None:
    """Take control until setpoints are accepted. Retries because a robot on a busy machine may end control."""

    def accepted() -> bool:
        if not in_control(panel):
            with contextlib.suppress(Error):  # the button is hidden or disabled while another operator has control
                panel.get_by_test_id("take-control").click(timeout=1000)
        return in_control(panel) and panel.get_by_test_id("stream-state").get_attribute("data-state") != "blocked"

    wait_until(accepted, "control")


def release_control(page: Page) -> None:
    """Release control unless the robot has ended it already."""
    with contextlib.suppress(Error):
        page.get_by_test_id("release-control").click(timeout=1000)


def reset_stop(panel: Page | Locator) -> None:
    panel.get_by_test_id("reset-stop").click()
    panel.get_by_test_id("confirm-reset").click()
    expect(panel.get_by_test_id("stop-banner")).to_be_hidden()


def press_until(
    panel: Page | Locator, press: Callable[[], None], release: Callable[[], None], moved: Callable[[], bool], what: str
) -> None:
    """Press an input with control until the simulation has moved, then release it.

    If setpoints are late on a busy machine, the robot holds and ends control; take it again.
    """
    page = panel if isinstance(panel, Page) else panel.page
    for _ in range(20):
        take_control(panel)
        press()
        for _ in range(100):
            if moved():
                release()
                return
            if not in_control(panel):
                break
            page.wait_for_timeout(50)
        release()
    pytest.fail(f"{what} never happened")


def press_key_until(panel: Page | Locator, key: str, moved: Callable[[], bool], what: str) -> None:
    keyboard = (panel if isinstance(panel, Page) else panel.page).keyboard
    press_until(panel, lambda: keyboard.down(key), lambda: keyboard.up(key), moved, what)


def move_the_elbow(page: Page, machine: Machine) -> None:
    """Move the elbow with the slider's keys until the simulation shows it."""
    slider, trace = page.get_by_test_id("slider-elbow"), machine.trace()
    before = elbow(trace)

    def moved() -> bool:
        if slider.is_enabled():
            slider.press("Shift+ArrowLeft")
        return abs(elbow(trace) - before) > 0.1

    press_until(page, lambda: None, lambda: None, moved, "motion of the elbow")


def drag(page: Page, share: float, joint: str = "elbow") -> None:
    """Drag a slider with the mouse to a share of its width, and keep the button pressed."""
    slider = page.get_by_test_id(f"slider-{joint}")
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    value, low, high = slider.evaluate("e => [e.valueAsNumber, Number(e.min), Number(e.max)]")
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] * (value - low) / (high - low), y)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * share, y, steps=5)


def drive(page: Page, share: float, reached: Callable[[], bool], what: str, *, release: bool = True) -> None:
    """Take control and drag the elbow until ``reached``."""

    def press() -> None:
        page.mouse.up()
        drag(page, share)
        if release:
            page.mouse.up()

    press_until(page, press, lambda: page.mouse.up() if release else None, reached, what)


def end_in_mid_motion(page: Page, trace: Trace, end: Callable[[], None]) -> float:
    """Take control, drag, and call ``end`` while the arm moves.

    Returns:
        Time from ``end`` to the last commanded motion [ms].
    """
    share = 0.75 if elbow(trace) < 0.5 else 0.25
    drive(page, share, lambda: commanded_speed(trace) > 0.2, "motion", release=False)
    end()
    ended_ms = time.time() * 1000
    wait_until(lambda: commanded_speed(trace) == 0, "rest")
    moving = [row["at_ms"] for row in speeds(trace) if row["speed"] > 1e-3]
    assert_at_rest(trace)
    return max(moving) - ended_ms


def assert_at_rest(trace: Trace, for_s: float = 1.0) -> None:
    """Assert that the simulated arm does not move for a time [s] of the simulation."""
    start = trace.now()
    wait_until(lambda: trace.now()["time_s"] > start["time_s"] + for_s, "simulated time")
    now = trace.now()
    assert all(abs(now["qpos"][name] - at) < 0.005 for name, at in start["qpos"].items()), (start, now)


def stopped_in_time(attempt: Callable[[], float]) -> bool:
    """Whether the arm stands still in time in one of some attempts."""
    return any(attempt() < STOP_WITHIN_MS for _ in range(_ATTEMPTS))


def speeds(trace: Trace, newest: int = 800) -> list[dict[str, float]]:
    """Commanded speed of the fastest joint between rows of the trace [rad/s]."""
    found = []
    for before, after in itertools.pairwise(trace.rows(newest)):
        step_s = after["time_s"] - before["time_s"]
        fastest = max(abs(after["target"][name] - before["target"][name]) for name in after["target"])
        found.append({"at_ms": after["at_ms"], "speed": fastest / step_s if step_s else 0.0})
    return found


def commanded_speed(trace: Trace) -> float:
    """Highest commanded speed of the last 0.15 s [rad/s]; a busy machine may delay some periods."""
    return max((row["speed"] for row in speeds(trace, 20)[-15:]), default=0.0)
