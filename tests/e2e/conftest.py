import os
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Playwright, sync_playwright

from tests.support.browser import FLAT, chromium
from tests.support.machine import Machine, start_machine


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
