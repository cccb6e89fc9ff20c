"""A robot type upload: errors with advice, preview, save and delete."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path

from playwright.sync_api import Browser, FilePayload, Locator, Page, expect

from tests.harness.browser.browser import pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import wait_until

MANIFEST = """type = "reacher"
version = 1
label = "Reacher"
kind = "arm"
description = "Two joints, one above the other."
model = "reacher.xml"
scene = "scene.xml"
driver = "mujoco"
period_ms = 20
braking_rad_s2 = 12.0
frames = ["tip"]
capabilities = ["joints", "movements"]
home_rad = { shoulder = 0.0, elbow = 0.5 }

[[streams]]
name = "joints"
rate_hz = 20.0
""" + "".join(
    f"""
[[joints]]
name = "{name}"
label = "{name.capitalize()}"
lower_rad = -1.5
upper_rad = 1.5
max_velocity_rad_s = 1.5
max_acceleration_rad_s2 = 6.0
max_jerk_rad_s3 = 60.0
max_effort_nm = 20.0
"""
    for name in ("shoulder", "elbow")
)
MODEL = """<mujoco model="reacher"><compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="base">
      <geom type="cylinder" size="0.06 0.05" pos="0 0 0.05" rgba="0.3 0.35 0.4 1"/>
      <body name="upper" pos="0 0 0.12" gravcomp="1">
        <joint name="shoulder" axis="0 1 0" range="-1.6 1.6" damping="1" armature="0.05"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.3" mass="0.5" rgba="0.16 0.5 0.75 1"/>
        <body name="lower" pos="0 0 0.3" gravcomp="1">
          <joint name="elbow" axis="0 1 0" range="-1.6 1.6" damping="1" armature="0.05"/>
          <geom type="capsule" size="0.025" fromto="0 0 0 0 0 0.25" mass="0.3" rgba="0.9 0.5 0.1 1"/>
          <site name="tip" pos="0 0 0.25"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="60" kv="4" ctrlrange="-1.5 1.5" forcerange="-20 20"/>
    <position name="elbow" joint="elbow" kp="60" kv="4" ctrlrange="-1.5 1.5" forcerange="-20 20"/>
  </actuator>
</mujoco>
"""
SCENE = """<mujoco model="reacher_scene">
  <include file="reacher.xml"/>
  <worldbody>
    <camera name="picture" pos="0.9 -0.9 0.6" xyaxes="0.7 0.7 0 -0.2 0.2 0.95"/>
    <geom name="floor" type="plane" size="1 1 0.1"/>
  </worldbody>
</mujoco>
"""
BOW = '"""Bow and return."""\nrobot.move_joints({"shoulder": 0.6}, speed=0.5)\nrobot.home()\n'
GOOD = {"robot.toml": MANIFEST, "reacher.xml": MODEL, "scene.xml": SCENE, "movements/bow.py": BOW}
WORSE = MODEL.replace("<worldbody>", '<asset><mesh name="hand" file="hand.stl"/></asset><worldbody>', 1).replace(
    '<site name="tip"', '<geom type="mesh" mesh="hand"/><site name="tip"'
)
BROKEN = {
    **GOOD,
    "robot.toml": MANIFEST.replace("upper_rad = 1.5", "upper_rad = 2.5", 1),
    "reacher.xml": WORSE,
    "scene.xml": SCENE.replace("</worldbody>", "</wurldbody>"),
}
"""Files with a limit wider than the joint's, a missing mesh, and invalid XML in line 6."""


def archive(files: Mapping[str, str]) -> FilePayload:
    """A zip archive of a folder, with the entries that file managers add."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive_file:
        for name, text in files.items():
            archive_file.writestr(f"reacher/{name}", text)
        archive_file.writestr("__MACOSX/reacher/._robot.toml", "x")
    return {"name": "reacher.zip", "mimeType": "application/zip", "buffer": buffer.getvalue()}


def at_step(page: Page, step: str) -> None:
    expect(page.locator(f"[data-testid=add-type][data-step={step}]")).to_be_visible()


def replace(page: Page, folder: Path, name: str, text: str) -> None:
    """Replace one selected file."""
    (folder / name).write_text(text)
    page.locator(f"[data-file='{name}'] input").set_input_files(folder / name)


def frames(view: Locator) -> int:
    return int(view.get_attribute("data-frames") or 0)


def finding(page: Page, kind: str, level: str = "error") -> Locator:
    return page.locator(f"[data-testid={level}][data-kind={kind}]")


def test_a_robot_type_is_corrected_previewed_saved_and_deleted(
    drawing_browser: Browser, machine: Machine, tmp_path: Path
) -> None:
    with pages(drawing_browser, machine) as (page,):
        page.get_by_role("link", name="Robot types").click()
        expect(page.locator("[data-testid=type-row][data-type='ur5']")).to_be_visible()
        expect(page.locator("[data-type='ur5']")).to_contain_text("1 device")
        page.get_by_test_id("add-robot-type").click()
        assert_good_page(page, "robot-type-add")
        check_rejection(page)
        check_correction(page, tmp_path)
        check_preview(page, machine)
        check_saving(page, machine)
        check_deletion(page, machine)

        # A built-in type has a picture too.
        page.locator("[data-type='ur5'] a").click()
        view = page.get_by_test_id("model-view")
        wait_until(lambda: frames(view) > 0, "a picture")
        expect(page.get_by_test_id("delete-type")).to_have_count(0)


def check_rejection(page: Page) -> None:
    """An invalid archive is rejected; all errors in a valid one are listed with file and advice."""
    invalid: FilePayload = {"name": "torn.zip", "mimeType": "application/zip", "buffer": b"PK\x03\x04 and no more"}
    page.get_by_test_id("type-files").set_input_files([invalid])
    expect(page.get_by_role("alert").filter(has_text="torn.zip cannot be extracted")).to_be_visible()

    page.get_by_test_id("type-files").set_input_files([archive(BROKEN)])
    at_step(page, "invalid")
    expect(finding(page, "malformed")).to_contain_text("scene.xml, line 6")
    expect(finding(page, "missing")).to_contain_text("reacher.xml, line 2")
    expect(finding(page, "missing")).to_contain_text("Add hand.stl, or remove the reference from reacher.xml.")
    expect(finding(page, "range").first).to_contain_text("limits joint shoulder to -91.7° to 91.7°")
    expect(page.get_by_test_id("error")).to_have_count(4)
    assert "Traceback" not in page.inner_text("body")
    assert_good_page(page, "robot-type-wrong")
    rows = page.locator("[data-testid=chosen-files] li")
    expect(rows).to_have_count(4)


def check_correction(page: Page, folder: Path) -> None:
    """The selected files remain and can be replaced one by one."""
    replace(page, folder, "scene.xml", SCENE)
    replace(page, folder, "robot.toml", MANIFEST)
    expect(page.get_by_test_id("error")).to_have_count(1)
    expect(finding(page, "missing")).to_be_visible()
    replace(page, folder, "reacher.xml", MODEL)
    at_step(page, "valid")


def check_preview(page: Page, machine: Machine) -> None:
    """The preview moves each joint; the type is not in the list before it is saved."""
    view = page.get_by_test_id("model-view")
    wait_until(lambda: frames(view) > 0, "a picture")
    before, first = frames(view), view.locator("canvas").screenshot()
    page.get_by_test_id("model-joint-elbow").focus()
    page.keyboard.press("End")
    wait_until(lambda: frames(view) > before, "another picture")
    expect(page.locator("output[for=model-joint-elbow]")).to_have_text("85.9°")
    assert view.locator("canvas").screenshot() != first, "the picture must change"
    expect(page.get_by_test_id("type-contents")).to_contain_text("Movements: 1")
    expect(page.get_by_test_id("type-contents")).to_contain_text("picture")
    with machine.api() as api:
        assert "reacher" not in [each["type"] for each in api.get("/robot-types")["items"]]
    assert_good_page(page, "robot-type-look")


def check_saving(page: Page, machine: Machine) -> None:
    """The saved type has a page and is in the list."""
    page.get_by_test_id("save-type").click()
    expect(page.get_by_test_id("type-saved")).to_be_visible()
    expect(page.locator("[data-testid=saved-movements] [data-accepted=true]")).to_have_text("bow accepted")
    expect(page.get_by_test_id("command-enroll")).to_have_value(enroll_command(machine))
    assert_good_page(page, "robot-type-saved")

    view = page.get_by_test_id("model-view")
    page.get_by_test_id("open-type").click()
    expect(page.get_by_test_id("type-movements")).to_contain_text("Bow and return.")
    wait_until(lambda: frames(view) > 0, "a picture")
    expect(page.get_by_test_id("joint-table").locator("tbody tr")).to_have_count(2)
    assert_good_page(page, "robot-type")
    page.get_by_role("link", name="Robot types", exact=True).click()
    expect(page.locator("[data-type='reacher'] [data-testid=type-state]")).to_have_attribute("data-state", "ready")
    assert_good_page(page, "robot-types")


def check_deletion(page: Page, machine: Machine) -> None:
    """A type in use cannot be deleted; an unused one can."""
    page.locator("[data-type='reacher'] a").click()
    page.get_by_test_id("delete-type").click()
    page.get_by_test_id("confirm-yes").click()
    expect(page.get_by_role("alert").filter(has_text="'reacher' is used by movement bow")).to_be_visible()
    with machine.api() as api:
        assert api.http.delete("/robot-types/reacher/movements/bow").is_success
    page.get_by_test_id("confirm-yes").click()
    expect(page.locator("[data-type='ur5']")).to_be_visible()
    expect(page.locator("[data-type='reacher']")).to_have_count(0)


def enroll_command(machine: Machine) -> str:
    words = "python -m device_agent enroll --home ~/reacher-agent"
    return f"{words} --server {machine.url} --device reacher=reacher --no-wait"
