"""Drivers are found by name."""

import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from device_agent import drivers
from device_agent.drivers import mujoco as mujoco_driver
from device_agent.ports import plugins
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROOT, UR5

CREATE: object = mujoco_driver.create


def third_party(monkeypatch: pytest.MonkeyPatch, **points: str) -> None:
    """Simulate installed packages with these entry points."""
    entry_points_ = EntryPoints(EntryPoint(name, value, drivers.GROUP) for name, value in points.items())
    monkeypatch.setattr(plugins, "entry_points", lambda *, group: entry_points_.select(group=group))


def test_unknown_driver_error_lists_the_valid_names(monkeypatch: pytest.MonkeyPatch):
    third_party(monkeypatch, acme="acme:create")
    with pytest.raises(DriverError, match=r"no driver 'mujco'; there are: acme, lerobot, mujoco"):
        drivers.load("mujco")


def test_third_party_drivers_are_found_but_do_not_replace_a_built_in_one(monkeypatch: pytest.MonkeyPatch):
    third_party(monkeypatch, acme="device_agent.drivers.mujoco:create", mujoco="pathlib:Path")
    assert drivers.load("acme") == CREATE
    assert drivers.load("mujoco") == CREATE


@pytest.mark.parametrize("target", ["acme_is_not_installed:create", "pathlib:create"])
def test_a_third_party_driver_that_cannot_be_imported_is_an_error(monkeypatch: pytest.MonkeyPatch, target: str):
    third_party(monkeypatch, acme=target)
    with pytest.raises(DriverError, match="driver 'acme' cannot be loaded"):
        drivers.load("acme")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sceen": "x.xml"}, r"no option 'sceen'; it has: faults, room, scene, trace"),
        *(({"trace": value}, "must be the path of a file") for value in (7, "", None, ["a"])),
    ],
)
def test_invalid_options_are_rejected(options: dict[str, object], message: str):
    with pytest.raises(DriverError, match=message):
        drivers.load("mujoco")(robot_type.load(UR5), UR5, options, "arm")


@pytest.mark.slow
def test_scene_can_be_chosen():
    driver = drivers.load("mujoco")(robot_type.load(UR5), UR5, {"scene": "ur5.xml"}, "arm")
    driver.connect()
    try:
        twin = driver.twin()
        assert twin is not None
        assert [body for body in twin.bodies if body.name == "scene" and body.geometries] == []
    finally:
        driver.close()


def test_a_missing_scene_is_an_error_at_connect(tmp_path: Path):
    driver = drivers.load("mujoco")(robot_type.load(UR5), tmp_path, {}, "arm")
    with pytest.raises(DriverError, match=r"scene\.xml"):
        driver.connect()


@pytest.mark.slow
def test_importing_a_driver_needs_no_display_and_listing_needs_no_simulator():
    script = """
import sys
from device_agent import drivers
assert "mujoco" in drivers.names() and "mujoco" not in sys.modules
drivers.load("mujoco")
assert "mujoco" in sys.modules
assert not [name for name in sys.modules if name.startswith(("OpenGL", "glfw"))]
"""
    environment = {"PATH": "/usr/bin:/bin"}  # no DISPLAY, no MUJOCO_GL
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
