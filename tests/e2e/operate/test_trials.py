"""The page of a task starts a trial on a simulated arm, and shows its verdict."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine, enroll
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

TYPE, TASK = "ur5_gripper", "red_cube_in_green_tray"
WITHIN_MS = 300_000


@pytest.fixture
def gripper(machine: Machine, tmp_path: Path) -> Iterator[str]:
    """The device of a running agent with a simulated gripper arm."""
    with machine.api() as api:
        agent = enroll(machine, api, tmp_path, f"grip={TYPE}")
        command = [sys.executable, "-m", "device_agent", "run", "--home", str(tmp_path)]
        with (
            (tmp_path / "log").open("wb") as log,
            subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, env=os.environ) as process,
        ):
            try:
                wait_until(lambda: api.get(f"/devices/{agent}-grip")["online"], "the agent")
                yield f"{agent}-grip"
            finally:
                process.kill()
        api.http.delete(f"/agents/{agent}").raise_for_status()


@pytest.mark.timeout(600)
def test_a_trial_is_started_and_its_verdict_is_shown(browser: Browser, machine: Machine, gripper: str) -> None:
    with pages(browser, machine) as (page,):
        page.evaluate("type => { location.hash = `#/tasks/${type}`; }", TYPE)
        row = page.locator(f"[data-testid=task-row][data-task={TASK}]")
        expect(row).to_contain_text("no trials yet")
        assert_good_page(page, "tasks")
        row.get_by_role("link").click()
        expect(page.get_by_test_id("condition")).to_contain_text("The robot lifts the red cube by at least 50 mm.")
        expect(page.get_by_text("There are no trials of this task yet.")).to_be_visible()
        assert_good_page(page, "task-empty")

        form = page.get_by_test_id("start-trial")
        form.get_by_label("Seed").fill("1.5")
        expect(page.get_by_test_id("run-trial")).to_be_disabled()
        form.get_by_label("Seed").fill("3")
        page.get_by_test_id("run-trial").click()
        expect(page.get_by_test_id("start-message")).to_contain_text("The trial was started.")
        trial = page.get_by_test_id("trial")
        expect(trial).to_have_attribute("data-state", "success", timeout=WITHIN_MS)
        expect(trial).to_contain_text("seed 3")
        expect(page.get_by_test_id("rate-of-all")).to_contain_text("1 of 1 (100 %)", timeout=60_000)
        assert_good_page(page, "task")

        page.get_by_text("Failed", exact=True).click()
        expect(page.get_by_text("No trial matches the filter.")).to_be_visible()
        page.get_by_text("All", exact=True).click()
        trial.get_by_role("link", name="Session").click()
        expect(page.get_by_role("main")).to_be_visible()
        assert f"/devices/{gripper}/sessions/" in page.url


def test_a_robot_type_without_tasks_says_so(browser: Browser, machine: Machine) -> None:
    with pages(browser, machine) as (page,):
        page.evaluate("() => { location.hash = '#/robot-types/ur5'; }")
        page.get_by_test_id("to-tasks").click()
        expect(page.get_by_text("This robot type has no tasks.")).to_be_visible()
        page.evaluate("type => { location.hash = `#/tasks/${type}/none`; }", TYPE)
        expect(page.get_by_role("alert")).to_contain_text("none")
        assert_good_page(page, "task-unknown")
