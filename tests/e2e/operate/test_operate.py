"""An operator in Chromium with a simulated robot; the simulation trace is the measurement."""

import contextlib
import json
import math
import os
import signal
import subprocess
import threading
import time
from typing import Any

from playwright.sync_api import Browser, Page, Playwright, expect

from tests.harness.agent.arm import (
    commanded_speed,
    drive,
    elbow,
    end_in_mid_motion,
    operator,
    release,
    shown,
    stopped_in_time,
    take,
)
from tests.harness.browser.browser import FLAT, PATIENCE_MS
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import PATIENCE_S, wait_until


def reset(page: Page) -> None:
    page.get_by_test_id("reset-stop").click()
    page.get_by_test_id("confirm-reset").click()
    expect(page.get_by_test_id("stop-banner")).to_be_hidden(timeout=PATIENCE_MS)


def test_the_elbow_slider_works_only_for_the_operator_in_control(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    with operator(browser, machine) as ann, operator(browser, machine) as bob:
        expect(ann.get_by_test_id("online")).to_contain_text("online", ignore_case=True)
        before = elbow(trace)
        slider = ann.get_by_test_id("slider-elbow")

        def arrived() -> bool:
            return abs(math.degrees(elbow(trace)) - float(slider.input_value())) < 1.5

        drive(ann, 0.6, lambda: abs(elbow(trace) - before) > 0.2 and arrived(), "the elbow following the slider")
        wait_until(lambda: abs(shown(ann) - math.degrees(elbow(trace))) < 0.5, "the page to show it")
        round_trip = ann.get_by_test_id("round-trip")
        assert float(round_trip.get_attribute("data-value") or "nan") > 0

        # The other browser shows the motion and cannot control it.
        wait_until(lambda: abs(shown(bob) - math.degrees(elbow(trace))) < 0.5, "the other page to show it")
        expect(bob.get_by_test_id("slider-elbow")).to_be_disabled()
        if ann.get_by_test_id("control-state").get_attribute("data-state") != "mine":
            take(ann)  # the robot may have ended control on a busy machine
        rest = elbow(trace)
        expect(bob.get_by_test_id("ask-control")).to_be_visible(timeout=PATIENCE_MS)
        expect(bob.get_by_test_id("take-control")).to_have_count(0)
        assert_not_moved_by_force(bob)
        assert abs(elbow(trace) - rest) < 0.005
        ann.get_by_test_id("release-control").click()
        expect(ann.get_by_test_id("control-state")).not_to_have_attribute("data-state", "mine", timeout=PATIENCE_MS)


def assert_not_moved_by_force(page: Page) -> None:
    """Direct requests of a page without the lease get no credentials and no action."""
    device = page.evaluate("() => fetch('/api/v1/devices').then(r => r.json())")["items"][0]
    csrf = page.evaluate("() => fetch('/api/v1/accounts/me').then(r => r.json())")["csrf_token"]
    ask = """([path, body, csrf]) => fetch('/api/v1' + path, {method: 'POST', body: JSON.stringify(body),
        headers: {'Content-Type': 'application/json', 'X-CSRF-Token': csrf}}).then(r => r.status)"""
    epoch = device["lease"]["epoch"]
    credentials = {"purpose": "control", "device": device["id"], "epoch": epoch}
    assert page.evaluate(ask, ["/mqtt/credentials", credentials, csrf]) in {403, 409}
    move = {"kind": "move_joints", "position_rad": {"elbow": 0.0}}
    for body in ({"request": move}, {"request": move, "epoch": epoch}):
        assert page.evaluate(ask, [f"/devices/{device['id']}/actions", body, csrf]) == 409


def test_stop_latches_until_it_is_reset(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    with operator(browser, machine) as page:
        drive(page, 0.25, lambda: commanded_speed(trace) > 0.1, "motion")
        page.keyboard.press("Escape")
        expect(page.get_by_test_id("stop-banner")).to_be_visible()
        wait_until(lambda: commanded_speed(trace) == 0, "rest")
        wait_until(lambda: page.get_by_test_id("slider-elbow").is_disabled(), "the sliders to be locked")
        rest = elbow(trace)
        page.wait_for_timeout(1000)
        assert abs(elbow(trace) - rest) < 0.005
        reset(page)
        page.wait_for_timeout(500)
        assert abs(elbow(trace) - rest) < 0.005, "resetting Stop must resume nothing"
        drive(page, 0.8, lambda: abs(elbow(trace) - rest) > 0.05, "motion after control was taken again")
        release(page)


def test_closing_the_browser_in_mid_motion_stops_the_arm(browser: Browser, machine: Machine) -> None:
    def attempt() -> float:
        with operator(browser, machine) as page:
            return end_in_mid_motion(page, machine.trace(), page.close)

    assert stopped_in_time(attempt)


def test_the_view_the_plot_and_the_pose_table_are_alive(drawing_browser: Browser, machine: Machine) -> None:
    with operator(drawing_browser, machine) as page:
        view = page.get_by_test_id("view-3d")
        view.scroll_into_view_if_needed()
        wait_until(lambda: int(view.get_attribute("data-frames") or 0) > 0, "the 3D view to be drawn")
        expect(page.get_by_test_id("plot").locator("canvas").first).to_be_visible()
        rows = page.get_by_test_id("poses").locator("tbody tr")
        assert rows.count() >= 6


def test_a_movement_runs_from_the_list(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    with operator(browser, machine) as page:
        page.get_by_test_id("movement-home").click()
        status = page.get_by_test_id("action-status")
        expect(status).to_have_attribute("data-status", "done", timeout=PATIENCE_MS)
        page.get_by_test_id("movement-wave").click()
        expect(status).to_have_attribute("data-status", "started", timeout=PATIENCE_MS)
        wait_until(lambda: commanded_speed(trace) > 0.1, "the simulation to wave")
        page.get_by_test_id("cancel-action").click()
        expect(status).to_have_attribute("data-status", "cancelled", timeout=PATIENCE_MS)
        wait_until(lambda: commanded_speed(trace) == 0, "rest")


def test_a_robot_that_goes_offline_is_shown_as_such(browser: Browser, machine: Machine) -> None:
    with operator(browser, machine) as page:
        online = page.get_by_test_id("online")
        expect(online).to_contain_text("online", ignore_case=True)
        # The supervisor restarts the killed agent; the page must show offline, then online.
        seen: list[str] = []
        ending = threading.Event()
        machine.kill("device_agent")
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s and not ending.is_set():
            text = (online.text_content() or "").lower()
            if text not in seen[-1:]:
                seen.append(text)
            if len(seen) > 1 and "online" in seen[-1]:
                ending.set()
            page.wait_for_timeout(20)
        assert any("offline" in text or "stale" in text for text in seen), seen
        assert "online" in seen[-1], seen


def test_a_phone_shows_all_of_it_without_sideways_scrolling(browser: Browser, machine: Machine) -> None:
    with operator(browser, machine) as page:
        page.set_viewport_size({"width": 390, "height": 844})
        fits = "() => document.documentElement.scrollWidth <= window.innerWidth"
        wait_until(lambda: page.evaluate(fits), "the page to fit")
        expect(page.get_by_test_id("stop")).to_be_in_viewport()


def credentials_of(machine: Machine) -> tuple[dict[str, Any], dict[str, Any]]:
    with machine.api() as api:
        return api.device(), api.post("/mqtt/credentials", {"purpose": "view"})


def mosquitto_sub(machine: Machine, topic: str, *more: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        ["mosquitto_sub", "-h", "127.0.0.1", "-p", str(machine.port + 1), "-V", "311", "-t", topic, "-W", "60", *more],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_mosquitto_sub_prints_the_telemetry_with_credentials_of_the_api_and_only_then(machine: Machine) -> None:
    device, given = credentials_of(machine)
    who = ("-i", given["client_id"], "-u", given["username"], "-P", given["password"])
    topic = f"{device['topic']}/tele/joints"
    allowed = mosquitto_sub(machine, topic, *who, "-C", "3")
    assert allowed.returncode == 0, allowed.stderr
    rows = [json.loads(line) for line in allowed.stdout.splitlines()]
    assert len(rows) == 3
    assert all(len(row["position_rad"]) == 6 and len(row["frames"]) >= 6 for row in rows)
    for refused in (
        mosquitto_sub(machine, topic),
        mosquitto_sub(machine, topic, *who[:4], "-P", "wrong"),
        mosquitto_sub(machine, "#", *who, "-C", "1"),
        mosquitto_sub(machine, f"{device['topic']}/cmd", *who, "-C", "1"),
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
