"""Movement pages in Chromium: write, save, version and run movements on real agents."""

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Api, Machine, Trace, enroll
from tests.harness.browser.steering import open_robot, reset_stop
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

SECOND = "second"
SCRIPT = '''"""Turn the last wrist."""

PARAMETERS = {
    "angle_rad": {"type": "number", "minimum": -1.5, "maximum": 1.5, "default": 0.2, "unit": "rad"},
    "wait_s": {"type": "number", "minimum": 0, "maximum": 30, "default": 0, "unit": "s"},
}

robot.move_joints({"wrist_3": parameters["angle_rad"]})
wait(parameters["wait_s"])
print("turned", parameters["angle_rad"])
'''
BROKEN = SCRIPT.replace("wait(parameters", "wait((parameters")
LEFT_OUT = "wait(parameters"


@pytest.fixture(scope="module")
def api(machine: Machine) -> Iterator[Api]:
    with machine.api() as api:
        yield api


@pytest.fixture
def second(machine: Machine, api: Api) -> Iterator[Trace]:
    """A second UR5 with its own agent for one test."""
    home = machine.home / "agents" / SECOND
    agent = enroll(machine, api, home, f"{SECOND}=ur5", "--name", SECOND)
    with (home / "log").open("w") as log:
        trace = ["--trace", str(home / "trace")]
        process = subprocess.Popen(
            [sys.executable, "-m", "device_agent", "run", "--home", str(home), *trace], cwd=ROOT, stdout=log, stderr=log
        )
    try:
        api.device(SECOND)
        yield Trace(home / "trace" / f"{SECOND}.ndjson")
    finally:
        process.terminate()
        process.wait(30)
        api.http.delete(f"/agents/{agent}")


@pytest.fixture
def name(api: Api, request: pytest.FixtureRequest) -> Iterator[str]:
    """Name of a movement for one test; version numbers are never reused."""
    name = "".join(part[0] for part in request.node.name.split("_")[1:])
    yield name
    api.http.delete(f"/robot-types/ur5/movements/{name}")
    device = api.device()["id"]
    home: dict[str, Any] = {"kind": "run_movement", "name": "home"}
    # Queued, because an action of the test may still run.
    api.post(f"/devices/{device}/actions", {"request": home, "policy": "queue", "wait_ms": 20_000, "wait_for": "done"})


def script(page: Page) -> Locator:
    return page.get_by_test_id("code").get_by_role("textbox")


def written(page: Page) -> str:
    return "\n".join(script(page).locator(".cm-line").all_text_contents())


def open_script(page: Page, machine: Machine, name: str) -> None:
    page.goto(f"{machine.url}/#/movements/ur5/{name}")
    expect(script(page)).to_be_visible()


def write(page: Page, text: str) -> None:
    """Replace the text of the editor."""
    script(page).click()
    page.keyboard.press("Control+a")
    page.keyboard.press("Delete")  # pasted lines trigger inline styles of Chromium, which the policy blocks
    page.keyboard.insert_text(text)


def save(page: Page, version: int) -> None:
    page.get_by_test_id("save-movement").click()
    expect(page.get_by_test_id("save-state")).to_have_attribute("data-version", str(version))
    expect(page.get_by_test_id("save-state")).to_have_attribute("data-changed", "false")


def wrist(trace: Trace) -> float:
    return float(trace.now()["qpos"]["wrist_3"])


def test_a_movement_is_written_corrected_and_saved(browser: Browser, machine: Machine, name: str) -> None:
    with pages(browser, machine) as (page,):
        page.get_by_role("link", name="Movements").click()
        expect(page.get_by_test_id("movement-entry-ur5-wave")).to_be_visible()
        page.get_by_test_id("movement-search").fill("square air")
        expect(page.get_by_test_id("movement-entry-ur5-slow_square")).to_be_visible()
        expect(page.get_by_test_id("movement-entry-ur5-wave")).to_have_count(0)
        page.get_by_test_id("movement-search").fill("")
        assert_good_page(page, "movements")

        page.get_by_test_id("new-type").select_option("ur5")
        page.get_by_test_id("new-name").fill("no spaces")
        page.get_by_test_id("new-movement").click()
        expect(page.get_by_test_id("new-name")).to_have_attribute("aria-invalid", "true")
        page.get_by_test_id("new-name").fill(name)
        page.get_by_test_id("new-movement").click()

        # The error is marked in its line; the text stays unsaved.
        write(page, BROKEN)
        problem = page.get_by_test_id("problem")
        expect(problem).to_have_count(1)
        line = BROKEN[: BROKEN.index(LEFT_OUT[:4] + "(")].count("\n") + 1
        assert int(problem.get_attribute("data-line") or 0) == line, problem.text_content()
        expect(page.get_by_test_id("code").locator(".cm-lintRange-error").first).to_be_visible()
        page.get_by_test_id("save-movement").click()
        expect(page.get_by_test_id("save-refused")).to_contain_text(f"Line {line}")
        assert written(page) == BROKEN
        assert_good_page(page, "movement-wrong")

        # Completion offers the script API and names of this robot type.
        write(page, "robot.mo")
        offered = page.get_by_test_id("code").locator(".cm-completionLabel")
        page.keyboard.press("Control+Space")
        expect(offered.filter(has_text="move_joints")).to_be_visible()
        page.wait_for_timeout(200)  # the completion list ignores keys right after it opens
        page.keyboard.press("Enter")
        assert written(page) == "robot.move_joints"
        page.keyboard.insert_text("({'el")
        page.keyboard.press("Control+Space")
        expect(offered.filter(has_text="elbow")).to_be_visible()
        page.keyboard.press("Escape")

        # Tab moves the focus.
        page.keyboard.press("Tab")
        assert page.evaluate("() => document.activeElement.dataset.testid") == "save-movement"

        write(page, SCRIPT)
        expect(page.get_by_test_id("problem-count")).to_have_attribute("data-count", "0")
        save(page, 1)


def test_a_movement_runs_with_parameters_from_a_form_and_its_failure_is_marked(
    browser: Browser, machine: Machine, api: Api, name: str
) -> None:
    api.http.put(f"/robot-types/ur5/movements/{name}", json={"source": SCRIPT}).raise_for_status()
    with pages(browser, machine) as (page,):
        open_script(page, machine, name)

        page.get_by_test_id("choose-ur5").check()
        # The parameter form uses degrees and reports values out of range.
        angle = page.get_by_test_id("parameter-angle_rad")
        angle.fill("120")
        page.get_by_test_id("run-many").click()
        expect(angle).to_have_attribute("aria-invalid", "true")
        angle.fill("40")
        page.get_by_test_id("run-many").click()
        row = page.get_by_test_id("run-ur5")
        wait_until(lambda: row.get_attribute("data-status") in {"done", "failed"}, "the run to end")
        assert row.get_attribute("data-status") == "done", row.inner_text()
        expect(row).to_contain_text("turned 0.69")
        wait_until(lambda: abs(wrist(machine.trace()) - 0.698) < 0.01, "the wrist to be turned by 40°")
        assert_good_page(page, "movement")

        # A failed run is marked in its line too.
        write(page, SCRIPT.replace('print("turned"', 'print(1 / 0, "turned"'))
        page.get_by_test_id("run-many").click()
        expect(row).to_have_attribute("data-status", "failed")
        failed = SCRIPT[: SCRIPT.index("print(")].count("\n") + 1
        marked = page.get_by_test_id("problem").filter(has_text="ZeroDivisionError")
        expect(marked).to_have_attribute("data-line", str(failed))

        # The last values are restored, also on the robot's page.
        page.goto(f"{machine.url}/#/")
        open_robot(page)
        page.get_by_test_id(f"parameters-{name}").click()
        expect(page.get_by_test_id("parameter-angle_rad")).to_have_value("40")
        page.get_by_test_id("parameter-angle_rad").fill("-30")
        assert_good_page(page, "movement-parameters", part="parameter-form")
        page.get_by_test_id("run-with").click()
        wait_until(lambda: abs(wrist(machine.trace()) + 0.5236) < 0.01, "the wrist to be turned by -30°")


def test_unsaved_text_is_kept_and_versions_can_be_restored(
    browser: Browser, machine: Machine, api: Api, name: str
) -> None:
    with pages(browser, machine, 2) as (mine, other):
        open_script(mine, machine, name)
        write(mine, SCRIPT)
        save(mine, 1)
        open_script(other, machine, name)
        expect(other.get_by_test_id("save-state")).to_have_attribute("data-version", "1")

        # Unsaved text survives a reload.
        write(mine, SCRIPT + "# mine\n")
        expect(mine.get_by_test_id("save-state")).to_have_attribute("data-changed", "true")
        mine.reload()
        expect(mine.get_by_test_id("restored")).to_be_visible()
        assert written(mine) == SCRIPT + "# mine\n"

        # The other tab saves first: its version is not overwritten, and both are shown.
        write(other, SCRIPT + "# theirs\n")
        save(other, 2)
        mine.get_by_test_id("save-movement").click()
        conflict = mine.get_by_test_id("conflict")
        expect(conflict).to_be_visible()
        expect(conflict.get_by_test_id("difference")).to_contain_text("# theirs")
        expect(conflict.get_by_test_id("difference")).to_contain_text("# mine")
        assert_good_page(mine, "movement-conflict")
        mine.get_by_test_id("save-over").click()
        expect(mine.get_by_test_id("save-state")).to_have_attribute("data-version", "3")

        # An older version is opened and saved as the newest.
        mine.get_by_test_id("version-2").get_by_role("button").click()
        expect(mine.get_by_test_id("restore-version")).to_be_visible()
        assert_good_page(mine, "movement-version")
        mine.get_by_test_id("restore-version").click()
        expect(mine.get_by_test_id("save-state")).to_have_attribute("data-version", "4")
        wait_until(lambda: written(mine) == SCRIPT + "# theirs\n", "the older text")
        assert api.get(f"/robot-types/ur5/movements/{name}")["source"] == SCRIPT + "# theirs\n"

        # A draft is discarded only after confirmation, and can be restored.
        write(mine, "1")
        mine.reload()
        mine.get_by_test_id("discard-draft").click()
        wait_until(lambda: written(mine) == SCRIPT + "# theirs\n", "the saved text")
        mine.get_by_role("button", name="Undo").click()
        wait_until(lambda: written(mine) == "1", "the discarded draft")

        # Deletion asks for confirmation inline.
        mine.goto(f"{machine.url}/#/movements")
        mine.get_by_test_id(f"remove-{name}").click()
        mine.get_by_test_id("confirm-yes").click()
        expect(mine.get_by_test_id(f"movement-entry-ur5-{name}")).to_have_count(0)


def test_one_movement_runs_on_many_robots_and_all_are_stopped_at_once(
    browser: Browser, machine: Machine, api: Api, second: Trace, name: str
) -> None:
    api.http.put(f"/robot-types/ur5/movements/{name}", json={"source": SCRIPT}).raise_for_status()
    with pages(browser, machine) as (page,):
        open_script(page, machine, name)
        page.get_by_role("button", name="Select all").click()
        expect(page.get_by_test_id("many-state")).to_be_visible()
        page.get_by_test_id("parameter-angle_rad").fill("20")
        page.get_by_test_id("run-many").click()
        rows = [page.get_by_test_id(f"run-{robot}") for robot in ("ur5", SECOND)]
        for row in rows:
            expect(row).to_have_attribute("data-status", "done")
        for trace in (machine.trace(), second):
            wait_until(lambda trace=trace: abs(wrist(trace) - 0.349) < 0.01, "the wrist to be turned by 20°")  # type: ignore[misc]

        # One run is cancelled, then the Stop key stops both, independent of the focus.
        page.get_by_test_id("parameter-wait_s").fill("30")
        page.get_by_test_id("run-many").click()
        for row in rows:
            expect(row).to_have_attribute("data-status", "started")
        assert_good_page(page, "movement-many")
        page.get_by_role("button", name="Cancel on").last.click()
        wait_until(lambda: "cancelled" in [row.get_attribute("data-status") for row in rows], "one to be cancelled")
        script(page).click()
        page.keyboard.press("Escape")
        expect(page.get_by_test_id("stop-banner")).to_have_count(2)
        for banner in page.get_by_test_id("stop-banner").all():
            expect(banner).to_have_attribute("data-state", "latched")

        # A robot that cannot run the movement gives the reason; the other robot runs it.
        page.get_by_test_id("reset-stop").first.click()
        page.get_by_test_id("confirm-reset").click()
        expect(page.get_by_test_id("stop-banner")).to_have_count(1)
        page.get_by_test_id("parameter-wait_s").fill("0")
        page.get_by_test_id("run-many").click()
        wait_until(lambda: min(str(row.get_attribute("data-status")) for row in rows) == "done", "one to be done", 20)
        reset_stop(page)
