"""Products and browsers of the end-to-end tests."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Playwright, sync_playwright

from tests.harness.browser.browser import FLAT, chromium
from tests.harness.browser.product import Machine, start_machine
from tests.harness.browser.robots import SIMULATED, Robot, real_robot

LABORATORY = {
    "test_health_pages",
    "test_keyframes",
    "test_live_sensors",
    "test_robot_actions",
    "test_room_devices",
    "test_room_pages",
    "test_steering",
}
"""Test files that use the product with all devices of the laboratory."""
OWN = {"test_fleet", "test_make_up", "test_sign_in", "test_tls", "test_xmpp", "test_xmpp_console"}
"""Test files that start their own product. All other files share a product with one arm."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """Run all tests of one product in the same xdist worker, so that the product starts once."""
    from xdist.scheduler import LoadScopeScheduling  # type: ignore[import-untyped]

    class ByProduct(LoadScopeScheduling):  # type: ignore[misc]
        def _split_scope(self, nodeid: str) -> str:
            name = Path(nodeid.partition("::")[0]).stem
            return "laboratory" if name in LABORATORY else name if name in OWN else "machine"

    return ByProduct(config, log)


@pytest.fixture(scope="session")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """The product with one arm. Tests share it and must restore its state."""
    with start_machine(tmp_path_factory.mktemp("machine")) as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        yield machine


@pytest.fixture(scope="session")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """The product with all devices of the laboratory. Tests share it and must restore its state."""
    with start_machine(tmp_path_factory.mktemp("laboratory"), TELESCOPE_ROOM="lab") as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        yield machine


VARIANTS = {"arm": ("ur5", "UR5", ("rtde", "rosbridge", "rospy")), "humanoid": ("nao", "NAO", ("naoqi",))}
"""Fixture → device, its label, and the protocols of real robots."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run the tests of a robot with the simulation and behind each protocol. Of the latter ``make test`` runs one."""
    for fixture, (_, _, protocols) in VARIANTS.items():
        if fixture in metafunc.fixturenames:
            real = [pytest.param(name, marks=pytest.mark.one_of("driver variants")) for name in protocols]
            metafunc.parametrize(fixture, [SIMULATED, *real], indirect=True, scope="module")


@pytest.fixture(scope="module")
def arm(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """A UR5."""
    yield from _robot("arm", request, tmp_path_factory)


@pytest.fixture(scope="module")
def humanoid(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """A NAO."""
    yield from _robot("humanoid", request, tmp_path_factory)


def _robot(fixture: str, request: pytest.FixtureRequest, folders: pytest.TempPathFactory) -> Iterator[Robot]:
    name, label, _ = VARIANTS[fixture]
    product = "laboratory" if request.path.stem in LABORATORY else "machine"
    machine: Machine = request.getfixturevalue(product)
    if request.param == SIMULATED:
        yield Robot(machine, name, label, machine.trace(name))
    else:
        with real_robot(machine, request.param, folders.mktemp(request.param)) as robot:
            yield robot


@pytest.fixture(scope="package")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="package")
def browser(playwright: Playwright, request: pytest.FixtureRequest) -> Iterator[Browser]:
    """A shared browser; each test opens its own context. 3D rendering is off unless pictures are requested."""
    if os.environ.get("TELESCOPE_PICTURES"):
        yield request.getfixturevalue("drawing_browser")
        return
    with chromium(playwright, FLAT) as browser:
        yield browser


@pytest.fixture(scope="package")
def drawing_browser(playwright: Playwright) -> Iterator[Browser]:
    """A shared browser with 3D rendering."""
    with chromium(playwright) as browser:
        yield browser
