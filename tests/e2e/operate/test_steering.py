"""Manual control by stick, keys, pads and gamepad: the robot moves only while an input is pressed."""

from collections.abc import Callable

from playwright.sync_api import Browser, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine, Trace
from tests.harness.browser.steering import (
    assert_at_rest,
    in_control,
    operator,
    press_key_until,
    press_until,
    release_control,
    reset_stop,
    take_control,
)
from tests.harness.network.brokers import wait_until

GAMEPAD = """() => {
    const pad = {
        id: "Scripted pad", index: 0, connected: true, mapping: "standard", timestamp: 0,
        axes: [0, 0, 0, 0],
        buttons: Array.from({length: 17}, () => ({pressed: false, touched: false, value: 0})),
    };
    window.scriptedPad = pad;
    navigator.getGamepads = () => (pad.connected ? [pad] : []);
}"""
PRESS = (
    "([index, down]) => { window.scriptedPad.buttons[index] = {pressed: down, touched: down, value: down ? 1 : 0}; }"
)
PUSH = "([axis, value]) => { window.scriptedPad.axes[axis] = value; }"
SHOULDER, B = 5, 1


def wheels(trace: Trace) -> tuple[float, float]:
    """Speeds of the Qbo's left and right wheel in the simulation [rad/s]."""
    turning = trace.now()["qvel"]
    return float(turning["left_wheel"]), float(turning["right_wheel"])


def speed(trace: Trace) -> float:
    """Speed of the fastest joint in a simulation [rad/s]."""
    return max(abs(float(each)) for each in trace.now()["qvel"].values())


def is_driving(trace: Trace) -> bool:
    return all(each > 0.5 for each in wheels(trace))


def is_at_rest(trace: Trace) -> bool:
    return all(abs(each) < 0.05 for each in wheels(trace))


def test_the_base_moves_while_stick_or_keys_are_pressed(browser: Browser, laboratory: Machine) -> None:
    trace = laboratory.trace("qbo")
    with operator(browser, laboratory, "Qbo") as page:
        page.get_by_test_id("tab-drive").click()
        page.get_by_test_id("show-keys").click()
        assert_good_page(page, "steer-drive", part="steer-card")
        page.get_by_test_id("show-keys").click()

        def stick() -> None:
            box = page.get_by_test_id("stick").bounding_box()
            assert box is not None
            page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            page.mouse.down()
            page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 2, steps=4)

        press_until(page, stick, page.mouse.up, lambda: is_driving(trace), "the stick driving")
        wait_until(lambda: is_at_rest(trace), "rest after the stick was released")

        page.get_by_test_id("stick").focus()
        press_key_until(page, "ArrowLeft", lambda: wheels(trace)[1] > 0.3 > -0.3 > wheels(trace)[0], "a turn")
        wait_until(lambda: is_at_rest(trace), "rest after the key was released")

        # Letter keys work anywhere except in text fields; a window without focus releases all inputs.
        page.get_by_test_id("tab-drive").focus()
        press_key_until(page, "w", lambda: is_driving(trace), "driving by the letter key")
        wait_until(lambda: is_at_rest(trace), "rest after the letter key was released")

        def leave() -> None:
            page.evaluate("() => dispatchEvent(new Event('blur'))")

        press_until(page, lambda: page.keyboard.down("w"), leave, lambda: is_driving(trace), "driving once more")
        wait_until(lambda: is_at_rest(trace), "rest after the window lost focus")
        page.keyboard.up("w")
        page.get_by_test_id("tab-joints").click()
        page.get_by_test_id("target-head_pan").focus()
        take_control(page)
        page.get_by_test_id("target-head_pan").focus()
        page.keyboard.down("t")
        page.keyboard.up("t")
        assert in_control(page), "a letter in a text field released control"
        release_control(page)


def test_a_frame_moves_while_a_pad_is_pressed(browser: Browser, laboratory: Machine) -> None:
    with operator(browser, laboratory, "UR5") as page:
        page.get_by_test_id("tab-jog").click()
        pose = page.get_by_test_id("live-pose")
        wait_until(lambda: bool(pose.get_attribute("data-value")), "the pose")

        def height() -> float:
            return float((pose.get_attribute("data-value") or "nan nan nan").split()[2])

        assert_good_page(page, "steer-jog", part="steer-card")
        pad = page.get_by_test_id("hold-z+")
        below = height()

        def press() -> None:
            pad.scroll_into_view_if_needed()
            pad.hover()
            page.mouse.down()

        press_until(page, press, page.mouse.up, lambda: height() > below + 0.02, "the frame rising")
        trace = laboratory.trace("ur5")
        wait_until(lambda: max(map(abs, trace.now()["qvel"].values())) < 0.01, "rest after the pad was released")
        press_key_until(page, "f", lambda: height() < below + 0.01, "the frame sinking by its key")

        # Joints by keys: the third is the elbow.
        page.get_by_test_id("tab-joints").click()
        elbow = float(trace.now()["qpos"]["elbow"])
        selected = page.locator(".joint.selected", has=page.get_by_test_id("measured-elbow"))

        def elbow_selected() -> bool:
            # The page listens to keys only after it has drawn the tab.
            take_control(page)
            page.keyboard.press("3")
            return selected.count() == 1

        wait_until(elbow_selected, "the selection of the elbow")
        page.get_by_role("heading", level=1).click()
        press_key_until(page, "ArrowDown", lambda: float(trace.now()["qpos"]["elbow"]) < elbow - 0.05, "the elbow")
        press_key_until(page, "ArrowUp", lambda: float(trace.now()["qpos"]["elbow"]) > elbow - 0.02, "the elbow back")
        page.keyboard.press("t")
        expect(page.get_by_test_id("take-control")).to_be_visible()


def test_a_gamepad_needs_its_dead_man_button(browser: Browser, laboratory: Machine) -> None:
    trace = laboratory.trace("qbo")
    with operator(browser, laboratory, "Qbo") as page:
        page.get_by_test_id("tab-drive").click()
        page.evaluate(GAMEPAD)
        expect(page.get_by_test_id("gamepad")).to_contain_text("Scripted pad")
        take_control(page)
        page.evaluate(PUSH, [1, -1.0])
        assert_at_rest(trace, 0.5)  # the stick alone does not drive

        def press(down: bool) -> Callable[[], None]:
            return lambda: page.evaluate(PRESS, [SHOULDER, down])

        press_until(page, press(True), press(False), lambda: is_driving(trace), "the gamepad driving")
        wait_until(lambda: is_at_rest(trace), "rest after the button was released")

        # A disconnect releases the input.
        def plug(connected: bool) -> Callable[[], None]:
            return lambda: page.evaluate("(connected) => { window.scriptedPad.connected = connected; }", connected)

        def plug_and_press() -> None:  # reconnect and press, because an earlier attempt may have disconnected it
            plug(True)()
            press(True)()

        press_until(page, plug_and_press, plug(False), lambda: is_driving(trace), "the gamepad driving again")
        wait_until(lambda: is_at_rest(trace), "rest after the gamepad was disconnected")
        expect(page.get_by_test_id("gamepad")).to_contain_text("disconnected", ignore_case=True)

        plug(True)()
        page.evaluate(PRESS, [B, True])
        expect(page.get_by_test_id("stop-banner")).to_have_attribute("data-state", "latched")
        page.evaluate(PRESS, [B, False])
        reset_stop(page)


def test_a_page_of_two_robots_has_separate_control_and_one_stop(browser: Browser, laboratory: Machine) -> None:
    with pages(browser, laboratory) as (page,):
        for name in ("UR5", "Qbo"):
            page.get_by_test_id("device-row").filter(has_text=name).get_by_test_id("pick").check()
        page.get_by_test_id("operate-together").click()
        panels = page.get_by_test_id("robot-panel")
        expect(panels).to_have_count(2)
        arm = panels.filter(has=page.get_by_role("heading", name="UR5"))
        qbo = panels.filter(has=page.get_by_role("heading", name="Qbo"))

        # Control is separate for each robot.
        take_control(arm)
        expect(qbo.get_by_test_id("control-state")).to_have_attribute("data-state", "free")
        take_control(qbo)
        assert_good_page(page, "together")

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
        press_key_until(qbo, "w", lambda: is_driving(trace), "driving the chosen one")
        assert speed(arm_trace) < 0.05, "the key moved the other robot"

        # The Stop key stops all robots while one moves.
        press_until(qbo, lambda: page.keyboard.down("w"), lambda: None, lambda: is_driving(trace), "driving again")
        page.keyboard.press("Escape")
        for panel in (arm, qbo):
            expect(panel.get_by_test_id("stop-banner")).to_have_attribute("data-state", "latched")
        wait_until(lambda: is_at_rest(trace), "rest after Stop")
        page.keyboard.up("w")
        for panel in (arm, qbo):
            reset_stop(panel)
        page.get_by_test_id("stop-all").click()
        for panel in (arm, qbo):
            reset_stop(panel)
