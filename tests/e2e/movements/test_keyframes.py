"""Keyframe editor: edit, preview, save, run and record, for arm, humanoid, base and head."""

import ast
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import pages, person
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import wait_until


def open_editor(page: Page, laboratory: Machine, name: str) -> None:
    """Open the keyframe editor from the robot's page and wait for the twin."""
    with laboratory.api() as api:
        device = api.device(name)["id"]
    page.goto(f"{laboratory.url}/#/devices/{device}")
    page.get_by_test_id("to-keyframes").click()
    expect(page.get_by_test_id("kf-track")).to_be_visible()
    wait_until(lambda: number(page, "kf-view", "frames") > 0, "the twin to be drawn")


def number(page: Page, test_id: str, name: str) -> float:
    return float(page.get_by_test_id(test_id).get_attribute(f"data-{name}") or "nan")


def set_joint(page: Page, joint: str, deg: float) -> None:
    field = page.get_by_test_id(f"target-{joint}")
    field.fill(str(deg))
    field.press("Enter")


def keyframes(page: Page) -> list[dict[str, Any]]:
    """Keyframes in the generated script."""
    source = page.get_by_test_id("kf-source").text_content() or ""
    tree = ast.parse(source)
    statement = next(
        each for each in tree.body if isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "KEYFRAMES"
    )
    read: list[dict[str, Any]] = ast.literal_eval(statement.value)
    return read


def save(page: Page, name: str) -> None:
    page.get_by_test_id("kf-name").fill(name)
    page.get_by_test_id("kf-save").click()
    expect(page.get_by_test_id("kf-save-status")).to_contain_text("Saved as version")


def run(page: Page) -> None:
    page.get_by_test_id("kf-run").click()
    status = page.get_by_test_id("action-status")
    wait_until(lambda: status.get_attribute("data-status") in {"done", "failed", "refused"}, "the run to end")
    assert status.get_attribute("data-status") == "done", status.text_content()


def test_keyframes_of_an_arm_are_edited_saved_and_run(drawing_browser: Browser, laboratory: Machine) -> None:
    with pages(drawing_browser, laboratory) as (page,):
        open_editor(page, laboratory, "ur5")

        # Two poses by number and slider. The motion between them is too fast; one click corrects the time.
        start = keyframes(page)[0]["position_rad"]
        page.get_by_test_id("kf-add").click()
        expect(page.get_by_test_id("kf-marker-2")).to_be_visible()
        set_joint(page, "shoulder_pan", 60)
        slider = page.get_by_test_id("slider-wrist_1")
        slider.focus()
        for _ in range(2):
            page.keyboard.press("PageUp")
        page.get_by_test_id("kf-interval").fill("0.3")
        page.get_by_test_id("kf-interval").press("Enter")
        problem = page.get_by_test_id("kf-problem-too-fast")
        expect(problem).to_contain_text("would exceed its")
        expect(page.get_by_test_id("kf-run")).to_be_disabled()
        page.get_by_test_id("kf-name").fill("kf-turn")
        assert_good_page(page, "keyframes-too-fast")
        problem.get_by_test_id("kf-fix").click()
        expect(page.get_by_test_id("kf-problems")).to_have_attribute("data-count", "0")
        assert number(page, "kf-marker-2", "time") > 0.6

        check_undo_and_redo(page)
        page.get_by_test_id("kf-duplicate").click()
        set_joint(page, "shoulder_pan", 75)
        set_joint(page, "shoulder_lift", -80)
        expect(page.get_by_test_id("kf-problems")).to_have_attribute("data-count", "0")

        # The preview moves only the twin.
        before = laboratory.trace().now()["qpos"]["shoulder_pan"]
        frames = number(page, "kf-view", "frames")
        page.get_by_test_id("kf-play").click()
        expect(page.get_by_test_id("kf-play")).to_have_attribute("aria-pressed", "false")
        assert number(page, "kf-view", "frames") > frames + 3
        assert abs(laboratory.trace().now()["qpos"]["shoulder_pan"] - before) < 1e-3

        # A draft survives a reload.
        page.reload()
        expect(page.get_by_test_id("kf-restored")).to_be_visible()
        made = keyframes(page)
        assert [len(made), made[0]["position_rad"]] == [3, start]
        page.get_by_test_id("kf-description").fill("Turns and looks around.")
        save(page, "kf-turn")
        page.get_by_test_id("kf-marker-2").focus()
        wait_until(lambda: number(page, "kf-view", "frames") > 0, "the twin to be drawn")
        assert_good_page(page, "keyframes")

        # The robot reaches the poses in order.
        run(page)
        reached = laboratory.trace().rows(3000)
        for one in made[1:]:
            expected = one["position_rad"]
            assert any(all(abs(row["qpos"][joint] - at) < 0.05 for joint, at in expected.items()) for row in reached), (
                expected
            )

        check_reopening(page, laboratory, made)


def check_undo_and_redo(page: Page) -> None:
    """Edit keyframes by keyboard."""
    page.get_by_test_id("kf-marker-2").focus()
    page.keyboard.press("ArrowRight")
    later = number(page, "kf-marker-2", "time")
    page.keyboard.press("Control+z")
    assert number(page, "kf-marker-2", "time") < later
    page.keyboard.press("Control+Shift+z")
    assert number(page, "kf-marker-2", "time") == later


def check_reopening(page: Page, laboratory: Machine, made: list[dict[str, Any]]) -> None:
    """Saved keyframes open again; a script that was edited by hand does not open as keyframes."""
    page.reload()
    expect(page.get_by_test_id("kf-track")).to_be_visible()
    assert keyframes(page) == made
    with laboratory.api() as api:
        path = "/robot-types/ur5/movements/kf-turn"
        saved = api.get(path)
        changed = {"source": saved["source"] + "robot.home()\n"}
        assert api.http.put(path, json=changed).is_success
    page.reload()
    expect(page.get_by_test_id("kf-manual-script")).to_be_visible()
    with laboratory.api() as api:
        assert api.http.delete("/robot-types/ur5/movements/kf-turn").is_success


def test_a_recorded_motion_is_trimmed_and_becomes_keyframes(drawing_browser: Browser, laboratory: Machine) -> None:
    with pages(drawing_browser, laboratory) as (page,):
        open_editor(page, laboratory, "ur5")
        home = keyframes(page)[0]["position_rad"]
        page.get_by_test_id("kf-record").click()
        with laboratory.api() as api:
            for position_rad in ({"shoulder_pan": home["shoulder_pan"] + 0.6}, home):
                request = {"kind": "move_joints", "position_rad": position_rad, "speed": 0.7}
                body = {"request": request, "wait_ms": 10_000, "wait_for": "done"}
                done = api.post(f"/devices/{api.device('ur5')['id']}/actions", body)
                assert done["status"] == "done", done
        page.get_by_test_id("kf-record").click()
        assert number(page, "kf-recorded", "samples") > 10
        expect(page.get_by_test_id("kf-use")).to_be_enabled()
        assert_good_page(page, "keyframes-record")
        lasts = page.get_by_test_id("kf-to").evaluate("e => Number(e.max)")
        page.get_by_test_id("kf-from").focus()
        for _ in range(6):
            page.keyboard.press("ArrowRight")
        page.get_by_test_id("kf-use").click()
        made = keyframes(page)
        assert len(made) >= 2
        assert made[0]["time_s"] == 0
        assert made[-1]["time_s"] < lasts - 0.2, "the start is trimmed"
        assert max(one["position_rad"].get("shoulder_pan", -9) for one in made) > home["shoulder_pan"] + 0.5
        page.get_by_test_id("kf-undo").click()
        assert len(keyframes(page)) == 1


@pytest.mark.parametrize(
    ("name", "joint", "deg", "deed"),
    [
        ("nao", "HeadYaw", 30, "kf-posture"),
        ("qbo", "head_pan", 25, "kf-drive"),
        ("hanson", "Neck-Rotation", 20, "kf-say"),
    ],
)
def test_the_same_editor_serves_every_robot(
    drawing_browser: Browser, laboratory: Machine, *, name: str, joint: str, deg: float, deed: str
) -> None:
    with pages(drawing_browser, laboratory) as (page,):
        open_editor(page, laboratory, name)
        page.get_by_test_id("kf-add").click()
        page.get_by_test_id("kf-interval").fill("1.5")
        page.get_by_test_id("kf-interval").press("Enter")
        set_joint(page, joint, deg)
        field = page.get_by_test_id(deed)
        if deed == "kf-drive":
            field.check()
        elif deed == "kf-say":
            field.fill("Hello")
        else:
            field.select_option(index=1)
        expect(page.get_by_test_id("kf-problems")).to_have_attribute("data-count", "0")
        save(page, "kf-look")
        assert len(keyframes(page)) == 2
        if name != "qbo":
            assert_good_page(page, f"keyframes-{name}")
        if name == "hanson":
            run(page)
            turned = page.get_by_test_id(f"measured-{joint}")
            wait_until(
                lambda: abs(float(turned.get_attribute("data-value") or "nan") - deg) < 2, "the head to turn", 10
            )
        with laboratory.api() as api:
            kind = api.device(name)["robot_type"]
            source = page.get_by_test_id("kf-source").text_content()
            assert api.post(f"/robot-types/{kind}/scripting/check", {"source": source})["diagnostics"] == []
            assert api.http.delete(f"/robot-types/{kind}/movements/kf-look").is_success


def test_keyframes_are_made_for_a_robot_type_without_a_robot(browser: Browser, laboratory: Machine) -> None:
    with person(browser, laboratory.sign_in_link()) as ann:
        expect(ann.get_by_test_id("signed-in")).to_be_visible()
        ann.goto(f"{laboratory.url}/#/movements")
        ann.get_by_test_id("new-type").select_option("nao")
        ann.get_by_test_id("new-keyframes").click()
        ann.get_by_test_id("kf-name").fill("at_ease")
        expect(ann.get_by_text("No robot is selected")).to_be_visible()
        for part in ("kf-run", "kf-record", "stop"):
            assert ann.get_by_test_id(part).count() == 0, f"{part}: no robot is selected"
        ann.get_by_test_id("kf-save").click()
        expect(ann.get_by_test_id("kf-save-status")).to_have_attribute("data-version", "1")
        assert_good_page(ann, "keyframes-type")
        # The movement's page opens it as keyframes again; no robot has moved.
        ann.goto(f"{laboratory.url}/#/movements/nao/at_ease")
        ann.get_by_test_id("as-keyframes").click()
        expect(ann.get_by_test_id("kf-name")).to_have_value("at_ease")
        expect(ann.get_by_test_id("kf-save")).to_be_disabled()
