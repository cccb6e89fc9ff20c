"""Actions of each of the four robots from its page, checked in the simulation and on the page."""

import math
from itertools import pairwise

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.browser.robots import Robot
from tests.harness.network.brokers import wait_until

STEPS = ("accepted", "started", "observed", "ended")


def open_robot(page: Page, machine: Machine, name: str) -> None:
    """Open the page of a robot and wait until it is online."""
    with machine.api() as api:
        device = api.device(name)["id"]
    page.goto(f"{machine.url}/#/devices/{device}")
    expect(page.get_by_test_id("online")).to_have_attribute("data-status", "online")


def press(page: Page, button: str) -> None:
    """Press a button once it is enabled, after the previous action ended."""
    expect(page.get_by_test_id(button)).to_be_enabled()
    page.get_by_test_id(button).click()


def assert_done(page: Page, kind: str, *, seen: str = "motion", nth: int = 0) -> None:
    """Assert that the newest command is done and its row shows every step in order."""
    row = page.get_by_test_id("command-trace-row").nth(nth)
    expect(row).to_have_attribute("data-kind", kind)
    expect(page.get_by_test_id("action-status")).to_have_attribute("data-status", "done")
    expect(row).to_have_attribute("data-observed-by", seen)
    times = {step: float(row.get_attribute(f"data-{step}") or "nan") for step in STEPS}
    assert times["accepted"] > 0
    # Without motion the robot's state counts, which may arrive before the acknowledgement.
    chains = [STEPS] if seen == "motion" else [("accepted", "started", "ended"), ("accepted", "observed", "ended")]
    for chain in chains:
        assert all(times[before] <= times[after] for before, after in pairwise(chain)), times


def frame(page: Page, row: int) -> list[float]:
    """Position in a row of the frame table [m]."""
    cell = page.get_by_test_id("poses").locator("tbody tr").nth(row).locator("td").first
    return [float(number) for number in (cell.text_content() or "").split()]


def joint(robot: Robot, name: str) -> float:
    """True position [rad]."""
    return float(robot.trace.now()["qpos"][name])


def test_the_arm_moves_to_a_pose_and_back(browser: Browser, arm: Robot) -> None:
    with pages(browser, arm.machine) as (page,):
        open_robot(page, arm.machine, arm.name)
        height = page.get_by_test_id("pose-2")
        wait_until(lambda: height.input_value() != "", "the pose to be filled in")
        before = {name: joint(arm, name) for name in ("shoulder_lift", "elbow", "wrist_1")}
        height.fill(f"{float(height.input_value()) - 0.08:.3f}")
        press(page, "pose-go")
        assert_done(page, "move_pose")
        assert abs(joint(arm, "elbow") - before["elbow"]) > 0.02
        # By the Denavit-Hartenberg convention, the second joint is at the frame of the first.
        position_m = frame(page, 0)
        page.get_by_text("All joints", exact=True).click()
        expect(page.get_by_test_id("poses").locator("tbody tr")).to_have_count(6)
        assert frame(page, 1) == pytest.approx(position_m, abs=0.002)
        assert_good_page(page, "arm")
        assert_good_page(page, "latency", part="command-trace")

        press(page, "undo-action")
        assert_done(page, "move_joints")
        for name, was in before.items():
            assert joint(arm, name) == pytest.approx(was, abs=0.02), name

        # An impossible pose is rejected with the robot's reason.
        height.fill("3")
        press(page, "pose-go")
        status = page.get_by_test_id("action-status")
        expect(status).to_have_attribute("data-status", "failed")
        expect(status.locator(".field-error")).not_to_be_empty()
        assert height.input_value() == "3"


def test_the_humanoid_assumes_a_posture_runs_a_behaviour_and_reduces_stiffness(
    browser: Browser, humanoid: Robot
) -> None:
    with pages(browser, humanoid.machine) as (page,):
        open_robot(page, humanoid.machine, humanoid.name)
        knee = joint(humanoid, "LKneePitch")
        press(page, "posture-Crouch")
        expect(page.get_by_test_id("behaviour-Hello")).to_be_disabled()
        assert_done(page, "take_posture")
        assert abs(joint(humanoid, "LKneePitch") - knee) > 0.2
        press(page, "undo-action")
        assert_done(page, "move_joints")
        assert joint(humanoid, "LKneePitch") == pytest.approx(knee, abs=0.1)

        press(page, "behaviour-Hello")
        expect(page.get_by_test_id("action-status")).to_have_attribute("data-status", "started")
        page.get_by_test_id("cancel-action").click()
        expect(page.get_by_test_id("action-status")).to_have_attribute("data-status", "cancelled")

        page.get_by_test_id("stiffness-joint").select_option("LHand")
        page.get_by_test_id("stiffness-value").fill("0.5")
        press(page, "stiffness-set")
        assert_done(page, "set_stiffness", seen="state")
        expect(page.get_by_test_id("stiffness-reported")).to_have_attribute("data-reduced", "1")
        assert_good_page(page, "humanoid")
        press(page, "undo-action")
        expect(page.get_by_test_id("stiffness-reported")).to_have_attribute("data-reduced", "0")


def test_the_mobile_robot_drives_to_a_goal_on_the_plan(browser: Browser, laboratory: Machine) -> None:
    with pages(browser, laboratory) as (page,):
        open_robot(page, laboratory, "qbo")
        mark = page.get_by_test_id("place-qbo")
        expect(mark).to_be_visible()
        was = tuple(float(mark.get_attribute(f"data-{axis}") or "nan") for axis in "xy")
        box, at = page.get_by_test_id("pick").bounding_box(), mark.bounding_box()
        assert box is not None
        assert at is not None
        # A goal near its position, then an exact goal by the fields.
        page.get_by_test_id("pick").click(
            position={"x": at["x"] + at["width"] / 2 - box["x"] + 8, "y": at["y"] + at["height"] / 2 - box["y"]}
        )
        expect(page.get_by_test_id("goal")).to_be_visible()
        assert float(page.get_by_test_id("place-x").input_value()) == pytest.approx(was[0], abs=0.6)
        press(page, "place-go")
        assert_done(page, "go_to")
        x_m, y_m = (float(page.get_by_test_id(f"place-{axis}").input_value()) for axis in "xy")
        wait_until(
            lambda: (
                math.hypot(
                    float(mark.get_attribute("data-x") or "nan") - x_m,
                    float(mark.get_attribute("data-y") or "nan") - y_m,
                )
                < 0.3
            ),
            "the room to measure the robot there",
            30,
        )
        press(page, "undo-action")
        assert_done(page, "go_to")
        # The robot's camera and the room's camera show frames. They come last, because rendering them delays the
        # positions that a goal needs.
        for view in (0, 1):
            page.get_by_test_id("watch-from").select_option(index=view)
            page.get_by_test_id("camera-live").click()
            wait_until(lambda: page.get_by_test_id("camera-picture").get_attribute("data-sequence"), "a picture")
        assert_good_page(page, "wheels")
        assert_good_page(page, "place", part="plan")


def test_the_head_shows_an_expression_and_says_a_sentence(browser: Browser, laboratory: Machine) -> None:
    with pages(browser, laboratory, 2) as (page, other):
        open_robot(page, laboratory, "hanson")
        page.get_by_test_id("strength").fill("0.8")
        press(page, "expression-happy")
        assert_done(page, "express")
        assert abs(laboratory.trace("hanson").now()["qpos"]["Smile-L"]) > 0.02

        open_robot(other, laboratory, "hanson")
        other.get_by_test_id("say-text").fill("This waits.")
        page.get_by_test_id("say-text").fill("Good morning.")
        page.get_by_test_id("say-text").press("Enter")
        assert_done(page, "say", seen="state")
        assert page.get_by_test_id("say-text").input_value() == ""
        expect(page.get_by_test_id("action-status")).to_contain_text("Good morning.")
        assert_good_page(page, "head")

        # A lease belongs to the session (decision 0008). Another tab of it sends actions under the same epoch, without
        # a new lease, so the first tab keeps control.
        page.get_by_test_id("take-control").click()
        expect(page.get_by_test_id("control-state")).to_have_attribute("data-state", "mine")
        expect(other.get_by_test_id("control-state")).to_have_text("You have control in another tab")
        assert other.get_by_test_id("say-text").input_value() == "This waits."
        with laboratory.api() as api:
            epoch = api.device("hanson")["lease"]["epoch"]
            press(other, "say")
            assert_done(other, "say", seen="state")
            assert api.device("hanson")["lease"]["epoch"] == epoch
        expect(other.get_by_test_id("control-state")).to_have_text("You have control in another tab")
        expect(page.get_by_test_id("control-state")).to_have_attribute("data-state", "mine")
        page.get_by_test_id("release-control").click()
        press(page, "expression-neutral")
        assert_done(page, "express")
