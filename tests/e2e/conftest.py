import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Playwright, sync_playwright

from tests.harness.browser.browser import FLAT, chromium
from tests.harness.browser.product import Machine, start_machine

LABORATORY = {
    "test_acts",
    "test_health_pages",
    "test_keyframes",
    "test_room_devices",
    "test_room_pages",
    "test_steering",
}
OWN = {"test_fleet", "test_make_up", "test_sign_in", "test_tls", "test_xmpp"}
"""Files that need the laboratory, and those that start what they need; the others share one arm."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """Where several workers share the tests, those of one product stay together, so that it is started once."""
    from xdist.scheduler import LoadScopeScheduling  # type: ignore[import-untyped]

    class ByProduct(LoadScopeScheduling):  # type: ignore[misc]
        def _split_scope(self, nodeid: str) -> str:
            name = Path(nodeid.partition("::")[0]).stem
            return "laboratory" if name in LABORATORY else name if name in OWN else "machine"

    return ByProduct(config, log)


@pytest.fixture(scope="session")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """The product, started once for all tests that leave it as they found it."""
    with start_machine(tmp_path_factory.mktemp("machine")) as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        yield machine


@pytest.fixture(scope="session")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """The product with all that is in its laboratory, started once for all tests that leave it as they found it."""
    with start_machine(tmp_path_factory.mktemp("laboratory"), TELESCOPE_ROOM="lab") as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        yield machine


@pytest.fixture(scope="package")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="package")
def browser(playwright: Playwright, request: pytest.FixtureRequest) -> Iterator[Browser]:
    """One for all tests, each with contexts of its own. It draws nothing in three dimensions but for pictures."""
    if os.environ.get("TELESCOPE_PICTURES"):
        yield request.getfixturevalue("drawing_browser")
        return
    with chromium(playwright, FLAT) as browser:
        yield browser


@pytest.fixture(scope="package")
def drawing_browser(playwright: Playwright) -> Iterator[Browser]:
    """One for all tests of what is drawn in three dimensions."""
    with chromium(playwright) as browser:
        yield browser
