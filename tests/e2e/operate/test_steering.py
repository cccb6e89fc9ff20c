"""Manual control by stick, keys, pads and gamepad: the robot moves only while an input is pressed."""

import contextlib
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, Error, Locator, Page, expect

from tests.harness.browser.browser import PATIENCE_MS, pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine, Trace
from tests.harness.network.brokers import wait_until

TRIES = 20
GAMEPAD = """() => {
    const made = {
        id: "Scripted pad", index: 0, connected: true, mapping: "standard", timestamp: 0,
        axes: [0, 0, 0, 0],
        buttons: Array.from({length: 17}, () => ({pressed: false, touched: false, value: 0})),
    };
    window.scriptedPad = made;
    navigator.getGamepads = () => (made.connected ? [made] : []);
}"""
PRESS = (
    "([index, down]) => { window.scriptedPad.buttons[index] = {pressed: down, touched: down, value: down ? 1 : 0}; }"
)
PUSH = "([axis, value]) => { window.scriptedPad.axes[axis] = value; }"
SHOULDER, B = 5, 1


@contextlib.contextmanager
def at(browser: Browser, machine: Machine, name: str) -> Iterator[Page]:
    """A user on a robot's page."""
    with pages(browser, machine) as (page,):
        page.get_by_test_id("device-row").filter(has_text=name).get_by_role("link").first.click()
        expect(page.get_by_test_id("control-state")).to_be_visible(timeout=PATIENCE_MS)
        yield page


def wheels(trace: Trace) -> tuple[float, float]:
    """Speeds of the Qbo's left and right wheel in the simulation [rad/s]."""
    turning = trace.now()["qvel"]
    return float(turning["left_wheel"]), float(turning["right_wheel"])


def rolls(trace: Trace) -> bool:
    return all(each > 0.5 for each in wheels(trace))


def stands(trace: Trace) -> bool:
    return all(abs(each) < 0.05 for each in wheels(trace))


def mine(station: Page | Locator) -> bool:
    return station.get_by_test_id("control-state").get_attribute("data-state") == "mine"


def take(station: Page | Locator) -> None:
    """Take control until the stream can start; retry if a busy robot ended control."""
    button, stream = station.get_by_test_id("take-control"), station.get_by_test_id("stream-state")

    def may() -> bool:
        if not mine(station):
            with contextlib.suppress(Error):  # the button disappeared or is still disabled
                button.click(timeout=1000)
        return mine(station) and stream.get_attribute("data-state") != "blocked"

    wait_until(may, "control")


def give_back(page: Page) -> None:
    with contextlib.suppress(Error):  # the robot may have ended control already
        page.get_by_test_id("release-control").click(timeout=1000)


def holding(
    station: Page | Locator,
    press: Callable[[], None],
    let_go: Callable[[], None],
    moved: Callable[[], bool],
    what: str,
) -> None:
    """Press an input until the simulation has moved, then release it.

    If setpoints are late on a busy machine, the robot holds and ends control; take it again.
    """
    page = station if isinstance(station, Page) else station.page
    for _ in range(TRIES):
        take(station)
        press()
        for _ in range(40):
            if moved():
                let_go()
                return
            if not mine(station):
                break
            page.wait_for_timeout(50)
        let_go()
    pytest.fail(f"{what} never happened")


def hold_key(station: Page | Locator, key: str, moved: Callable[[], bool], what: str) -> None:
    keyboard = (station if isinstance(station, Page) else station.page).keyboard
    holding(station, lambda: keyboard.down(key), lambda: keyboard.up(key), moved, what)


def test_the_base_moves_while_stick_or_keys_are_pressed(browser: Browser, laboratory: Machine) -> None:
    trace = laboratory.trace("qbo")
    with at(browser, laboratory, "Qbo") as page:
        page.get_by_test_id("tab-drive").click()
        page.get_by_test_id("show-keys").click()
        assert_good_page(page, "steer-drive", part="steer-card")
        page.get_by_test_id("show-keys").click()
        page.set_viewport_size({"width": 1440, "height": 900})

        def stick() -> None:
            box = page.get_by_test_id("stick").bounding_box()
            assert box is not None
            page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            page.mouse.down()
            page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 2, steps=4)

        holding(page, stick, page.mouse.up, lambda: rolls(trace), "the stick driving")
        wait_until(lambda: stands(trace), "rest after the stick was released")

        page.get_by_test_id("stick").focus()
        hold_key(page, "ArrowLeft", lambda: wheels(trace)[1] > 0.3 > -0.3 > wheels(trace)[0], "a turn by the arrow key")
        wait_until(lambda: stands(trace), "rest after the key was released")

        # Letter keys work anywhere except in text fields; a window without focus releases all inputs.
        page.get_by_test_id("tab-drive").focus()
        hold_key(page, "w", lambda: rolls(trace), "driving by the letter key")
        wait_until(lambda: stands(trace), "rest after the letter key was released")

        def leave() -> None:
            page.evaluate("() => dispatchEvent(new Event('blur'))")

        holding(page, lambda: page.keyboard.down("w"), leave, lambda: rolls(trace), "driving once more")
        wait_until(lambda: stands(trace), "rest after the window lost focus")
        page.keyboard.up("w")
        page.get_by_test_id("tab-joints").click()
        page.get_by_test_id("target-head_pan").focus()
        take(page)
        page.get_by_test_id("target-head_pan").focus()
        page.keyboard.down("t")
        page.keyboard.up("t")
        assert mine(page), "a letter in a text field released control"
        give_back(page)


def test_a_frame_moves_while_a_pad_is_pressed(browser: Browser, laboratory: Machine) -> None:
    with at(browser, laboratory, "UR5") as page:
        page.get_by_test_id("tab-jog").click()
        pose = page.get_by_test_id("live-pose")
        wait_until(lambda: bool(pose.get_attribute("data-value")), "the pose")

        def height() -> float:
            return float((pose.get_attribute("data-value") or "nan nan nan").split()[2])

        assert_good_page(page, "steer-jog", part="steer-card")
        page.set_viewport_size({"width": 1440, "height": 900})
        pad = page.get_by_test_id("hold-z+")
        below = height()

        def press() -> None:
            pad.scroll_into_view_if_needed()
            pad.hover()
            page.mouse.down()

        holding(page, press, page.mouse.up, lambda: height() > below + 0.02, "the frame rising")
        trace = laboratory.trace("ur5")
        wait_until(lambda: max(map(abs, trace.now()["qvel"].values())) < 0.01, "rest after the pad was released")
        hold_key(page, "f", lambda: height() < below + 0.01, "the frame sinking by its key")

        # Joints by keys: the third is the elbow.
        page.get_by_test_id("tab-joints").click()
        elbow = float(trace.now()["qpos"]["elbow"])
        page.keyboard.press("3")
        page.get_by_role("heading", level=1).click()
        hold_key(page, "ArrowDown", lambda: float(trace.now()["qpos"]["elbow"]) < elbow - 0.05, "the elbow by its key")
        hold_key(page, "ArrowUp", lambda: float(trace.now()["qpos"]["elbow"]) > elbow - 0.02, "the elbow back")
        page.keyboard.press("t")
        expect(page.get_by_test_id("take-control")).to_be_visible(timeout=PATIENCE_MS)


def test_a_gamepad_needs_its_dead_man_button(browser: Browser, laboratory: Machine) -> None:
    trace = laboratory.trace("qbo")
    with at(browser, laboratory, "Qbo") as page:
        page.get_by_test_id("tab-drive").click()
        page.evaluate(GAMEPAD)
        expect(page.get_by_test_id("gamepad")).to_contain_text("Scripted pad", timeout=PATIENCE_MS)
        take(page)
        page.evaluate(PUSH, [1, -1.0])
        page.wait_for_timeout(600)
        assert stands(trace), "it was driven without the button"

        def press(down: bool) -> Callable[[], None]:
            return lambda: page.evaluate(PRESS, [SHOULDER, down])

        holding(page, press(True), press(False), lambda: rolls(trace), "the gamepad driving")
        wait_until(lambda: stands(trace), "rest after the button was released")

        # A disconnect releases the input.
        def plug(there: bool) -> Callable[[], None]:
            return lambda: page.evaluate("(there) => { window.scriptedPad.connected = there; }", there)

        def plug_and_press() -> None:  # reconnect and press, because an earlier attempt may have disconnected it
            plug(True)()
            press(True)()

        holding(page, plug_and_press, plug(False), lambda: rolls(trace), "the gamepad driving again")
        wait_until(lambda: stands(trace), "rest after the gamepad was disconnected")
        expect(page.get_by_test_id("gamepad")).to_contain_text("disconnected", ignore_case=True)

        plug(True)()
        page.evaluate(PRESS, [B, True])
        expect(page.get_by_test_id("stop-banner")).to_have_attribute("data-state", "latched", timeout=PATIENCE_MS)
        page.evaluate(PRESS, [B, False])
        reset(page)


def test_a_page_of_two_robots_has_separate_control_and_one_stop(browser: Browser, laboratory: Machine) -> None:
    with pages(browser, laboratory) as (page,):
        for name in ("UR5", "Qbo"):
            page.get_by_test_id("device-row").filter(has_text=name).get_by_test_id("pick").check()
        page.get_by_test_id("operate-together").click()
        stations = page.get_by_test_id("robot-panel")
        expect(stations).to_have_count(2, timeout=PATIENCE_MS)
        arm = stations.filter(has=page.get_by_role("heading", name="UR5"))
        qbo = stations.filter(has=page.get_by_role("heading", name="Qbo"))

        # Control is separate for each robot.
        take(arm)
        expect(qbo.get_by_test_id("control-state")).to_have_attribute("data-state", "free")
        take(qbo)
        assert_good_page(page, "together")
        page.set_viewport_size({"width": 1440, "height": 900})

        # Keys move the selected robot, which is marked.
        trace = laboratory.trace("qbo")
        arm_trace = laboratory.trace("ur5")
        qbo.get_by_test_id("tab-drive").click()
        arm.get_by_test_id("tab-jog").click()
        expect(arm).to_have_attribute("data-chosen", "true")
        qbo.get_by_test_id("choose").click()
        expect(qbo).to_have_attribute("data-chosen", "true")
        expect(arm).to_have_attribute("data-chosen", "false")
        wait_until(lambda: speed(arm_trace) < 0.01, "the arm to rest")
        hold_key(qbo, "w", lambda: rolls(trace), "driving the chosen one")
        assert speed(arm_trace) < 0.05, "the key moved the other robot"

        # The Stop key stops all robots while one moves.
        holding(qbo, lambda: page.keyboard.down("w"), lambda: None, lambda: rolls(trace), "driving again")
        page.keyboard.press("Escape")
        for station in (arm, qbo):
            expect(station.get_by_test_id("stop-banner")).to_have_attribute(
                "data-state", "latched", timeout=PATIENCE_MS
            )
        wait_until(lambda: stands(trace), "rest after Stop")
        page.keyboard.up("w")
        for station in (arm, qbo):
            reset(station)
        page.get_by_test_id("stop-all").click()
        for station in (arm, qbo):
            reset(station)


def speed(trace: Trace) -> float:
    """Speed of the fastest joint in a simulation [rad/s]."""
    return max(abs(float(each)) for each in trace.now()["qvel"].values())


def reset(station: Locator | Page) -> None:
    station.get_by_test_id("reset-stop").click()
    station.get_by_test_id("confirm-reset").click()
    expect(station.get_by_test_id("stop-banner")).to_be_hidden(timeout=PATIENCE_MS)
