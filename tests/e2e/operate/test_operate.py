"""An operator in Chromium with an arm; its trace is the measurement."""

import contextlib
import json
import math
import os
import signal
import subprocess

from playwright.sync_api import Browser, Page, Playwright, expect

from tests.harness.browser.browser import FLAT
from tests.harness.browser.product import Machine
from tests.harness.browser.robots import Robot
from tests.harness.browser.steering import (
    assert_at_rest,
    commanded_speed,
    drive,
    elbow,
    end_in_mid_motion,
    operator,
    release_control,
    reset_stop,
    shown,
    stopped_in_time,
    take_control,
)
from tests.harness.network.brokers import wait_until


def test_the_elbow_slider_works_only_for_the_operator_in_control(browser: Browser, arm: Robot) -> None:
    trace = arm.trace
    with operator(browser, arm.machine, arm.label) as ann, operator(browser, arm.machine, arm.label) as bob:
        expect(ann.get_by_test_id("online")).to_contain_text("online", ignore_case=True)
        before = elbow(trace)
        slider = ann.get_by_test_id("slider-elbow")

        def arrived() -> bool:
            return abs(math.degrees(elbow(trace)) - float(slider.input_value())) < 1.5

        away = 0.4 if before > 0 else 0.6  # towards zero, so the elbow always moves
        drive(ann, away, lambda: abs(elbow(trace) - before) > 0.2 and arrived(), "the elbow following the slider")
        wait_until(lambda: abs(shown(ann) - math.degrees(elbow(trace))) < 0.5, "the page to show the position")
        round_trip = ann.get_by_test_id("round-trip")
        assert float(round_trip.get_attribute("data-value") or "nan") > 0

        # The other browser shows the motion and cannot control it.
        wait_until(lambda: abs(shown(bob) - math.degrees(elbow(trace))) < 0.5, "the other page to show the position")
        expect(bob.get_by_test_id("slider-elbow")).to_be_disabled()
        take_control(ann)  # the robot may have ended control on a busy machine
        rest = elbow(trace)
        expect(bob.get_by_test_id("request-control")).to_be_visible()
        expect(bob.get_by_test_id("take-control")).to_have_count(0)
        assert_not_moved_by_force(bob, arm)
        assert abs(elbow(trace) - rest) < 0.005
        ann.get_by_test_id("release-control").click()
        expect(ann.get_by_test_id("control-state")).not_to_have_attribute("data-state", "mine")


def assert_not_moved_by_force(page: Page, arm: Robot) -> None:
    """Direct requests of a page without the lease get no credentials and no action."""
    devices = page.evaluate("() => fetch('/api/v1/devices').then(r => r.json())")["items"]
    (device,) = [each for each in devices if each["name"] == arm.name]
    csrf = page.evaluate("() => fetch('/api/v1/accounts/me').then(r => r.json())")["csrf_token"]
    post = """([path, body, csrf]) => fetch('/api/v1' + path, {method: 'POST', body: JSON.stringify(body),
        headers: {'Content-Type': 'application/json', 'X-CSRF-Token': csrf}}).then(r => r.status)"""
    epoch = device["lease"]["epoch"]
    credentials = {"purpose": "control", "device": device["id"], "epoch": epoch}
    assert page.evaluate(post, ["/mqtt/credentials", credentials, csrf]) in {403, 409}
    move = {"kind": "move_joints", "position_rad": {"elbow": 0.0}}
    for body in ({"request": move}, {"request": move, "epoch": epoch}):
        assert page.evaluate(post, [f"/devices/{device['id']}/actions", body, csrf]) == 409


def test_stop_latches_until_it_is_reset(browser: Browser, arm: Robot) -> None:
    trace = arm.trace
    with operator(browser, arm.machine, arm.label) as page:
        drive(page, 0.25, lambda: commanded_speed(trace) > 0.1, "motion")
        page.keyboard.press("Escape")
        expect(page.get_by_test_id("stop-banner")).to_be_visible()
        wait_until(lambda: commanded_speed(trace) == 0, "rest")
        wait_until(lambda: page.get_by_test_id("slider-elbow").is_disabled(), "the sliders to be locked")
        rest = elbow(trace)
        assert_at_rest(trace)
        reset_stop(page)
        assert_at_rest(trace)  # resetting Stop resumes nothing
        drive(page, 0.8, lambda: abs(elbow(trace) - rest) > 0.05, "motion after control was taken again")
        release_control(page)


def test_closing_the_browser_in_mid_motion_stops_the_arm(browser: Browser, machine: Machine) -> None:
    def attempt() -> float:
        with operator(browser, machine) as page:
            return end_in_mid_motion(page, machine.trace(), page.close)

    assert stopped_in_time(attempt)


def test_the_view_the_plot_and_the_pose_table_are_updated(drawing_browser: Browser, machine: Machine) -> None:
    with operator(drawing_browser, machine) as page:
        view = page.get_by_test_id("view-3d")
        view.scroll_into_view_if_needed()
        wait_until(lambda: int(view.get_attribute("data-frames") or 0) > 0, "the 3D view to be drawn")
        expect(page.get_by_test_id("plot").locator("canvas").first).to_be_visible()
        rows = page.get_by_test_id("poses").locator("tbody tr")
        assert rows.count() >= 6


def test_a_movement_runs_from_the_list(browser: Browser, arm: Robot) -> None:
    trace = arm.trace
    with operator(browser, arm.machine, arm.label) as page:
        page.get_by_test_id("movement-home").click()
        status = page.get_by_test_id("action-status")
        expect(status).to_have_attribute("data-status", "done")
        page.get_by_test_id("movement-wave").click()
        expect(status).to_have_attribute("data-status", "started")
        wait_until(lambda: commanded_speed(trace) > 0.1, "the simulation to wave")
        page.get_by_test_id("cancel-action").click()
        expect(status).to_have_attribute("data-status", "cancelled")
        wait_until(lambda: commanded_speed(trace) == 0, "rest")


STATUSES = """() => {
    window.statuses = [];
    const record = () => {
        const status = document.querySelector("[data-testid=online]");
        if (status !== null) window.statuses.push(status.textContent.toLowerCase());
    };
    new MutationObserver(record).observe(document.body, {subtree: true, childList: true, characterData: true});
}"""
"""Records every status of the robot, because the agent may be back before the test reads it."""


def test_a_robot_that_goes_offline_is_shown_as_such(browser: Browser, machine: Machine) -> None:
    with operator(browser, machine) as page:
        online = page.get_by_test_id("online")
        expect(online).to_contain_text("online", ignore_case=True)
        # The supervisor restarts the killed agent; the page must show offline, then online.
        page.evaluate(STATUSES)
        machine.kill("device_agent")

        def back_online() -> bool:
            seen: list[str] = page.evaluate("() => window.statuses")
            return any("offline" in text or "stale" in text for text in seen) and "online" in seen[-1]

        wait_until(back_online, "offline, then online")


def mosquitto_sub(machine: Machine, topic: str, *more: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        ["mosquitto_sub", "-h", "127.0.0.1", "-p", str(machine.port + 1), "-V", "311", "-t", topic, "-W", "60", *more],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_mosquitto_sub_prints_the_telemetry_with_credentials_of_the_api_and_only_then(machine: Machine) -> None:
    with machine.api() as api:
        device, issued = api.device(), api.post("/mqtt/credentials", {"purpose": "view"})
    login = ("-i", issued["client_id"], "-u", issued["username"], "-P", issued["password"])
    topic = f"{device['topic']}/tele/joints"
    allowed = mosquitto_sub(machine, topic, *login, "-C", "3")
    assert allowed.returncode == 0, allowed.stderr
    rows = [json.loads(line) for line in allowed.stdout.splitlines()]
    assert len(rows) == 3
    assert all(len(row["position_rad"]) == 6 and len(row["frames"]) >= 6 for row in rows)
    for refused in (
        mosquitto_sub(machine, topic),
        mosquitto_sub(machine, topic, *login[:4], "-P", "wrong"),
        mosquitto_sub(machine, "#", *login, "-C", "1"),
        mosquitto_sub(machine, f"{device['topic']}/cmd", *login, "-C", "1"),
    ):
        assert refused.stdout == ""
        assert refused.returncode != 0 or "denied" in refused.stderr


def test_a_browser_that_is_killed_in_mid_motion_stops_the_arm(playwright: Playwright, machine: Machine) -> None:
    """A killed browser sends nothing, so only the robot's watchdog can stop the arm."""
    mark = "--named-by-a-test"

    def kill() -> None:
        listed = subprocess.run(["pgrep", "-f", "--", mark], capture_output=True, text=True, check=True).stdout
        for pid in listed.split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)

    def attempt() -> float:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=[*FLAT, mark])
        with operator(browser, machine) as page:
            return end_in_mid_motion(page, machine.trace(), kill)

    assert stopped_in_time(attempt)
