"""The console lists the movements of a robot with the wrapper for legacy robots, and starts and cancels them."""

import contextlib
import re
import sys
from pathlib import Path

from playwright.sync_api import Browser, expect

from tests.harness.browser.browser import person
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.hosts.host import environment_of, start_program
from tests.harness.paths import ROOT

WRAPPER = ROOT / "examples" / "legacy" / "telescope_legacy.py"


def test_movements_of_a_legacy_robot_are_started_and_cancelled(
    browser: Browser, machine: Machine, tmp_path: Path
) -> None:
    movements, home = tmp_path / "movements", ["--home", str(tmp_path / "home")]
    movements.mkdir()
    (movements / "wave.py").write_text("print('waves')\n")
    (movements / "walk.py").write_text("import time\nprint('walks')\ntime.sleep(1000)\n")
    with contextlib.ExitStack() as stack:
        environment = environment_of({})
        command = [str(WRAPPER), "enroll", "--url", machine.url, "--name", "legacy", *home]
        enrolling = stack.enter_context(start_program(command, environment, python=sys.executable))
        code = enrolling.read_line().removeprefix("claim code: ").split()[0]
        api = stack.enter_context(machine.api())
        device = api.post("/agents/claim", {"code": code})["devices"][0]
        stack.callback(api.http.delete, f"/agents/{device['agent']}")
        assert enrolling.process.wait(30) == 0
        command = [str(WRAPPER), "run", "--movements", str(movements), *home]
        stack.enter_context(start_program(command, environment, python=sys.executable))

        page = stack.enter_context(person(browser, machine.sign_in_link()))
        expect(page.get_by_test_id("signed-in")).to_be_visible()
        page.get_by_test_id("device-row").filter(has_text="legacy").get_by_role("link").first.click()
        page.get_by_test_id("behaviour-wave").click()
        expect(page.get_by_test_id("action-status")).to_have_attribute("data-status", "done")
        page.get_by_test_id("behaviour-walk").click()
        expect(page.get_by_test_id("action-status")).to_have_attribute("data-status", "started")
        page.get_by_test_id("cancel-action").click()
        expect(page.get_by_test_id("action-status")).to_have_attribute("data-status", re.compile("cancelled"))
        assert_good_page(page, "legacy")
