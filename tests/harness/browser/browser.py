"""A signed-in user in Chromium. A script error or a violation of the content policy fails the test."""

import contextlib
from collections.abc import Iterator

from playwright.sync_api import Browser, Error, Page, Playwright, expect

from tests.harness.browser.product import Machine

PATIENCE_MS = 90_000
"""Timeout for elements to appear on a busy machine [ms]."""
expect.set_options(timeout=PATIENCE_MS)
_COMMON = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
FLAGS = [*_COMMON, "--enable-unsafe-swiftshader"]
FLAT = [*_COMMON, "--disable-3d-apis"]
"""Chromium arguments without 3D rendering, which is expensive without a graphics card."""


@contextlib.contextmanager
def chromium(playwright: Playwright, flags: list[str] = FLAGS) -> Iterator[Browser]:
    """Chromium of this machine, closed on exit."""
    browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=flags)
    try:
        yield browser
    finally:
        browser.close()


@contextlib.contextmanager
def tabs(browser: Browser, count: int = 1) -> Iterator[list[Page]]:
    """Empty tabs of one browser context. Fails on script errors and policy violations."""
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    context.set_default_timeout(PATIENCE_MS)
    errors: list[str] = []
    opened = [context.new_page() for _ in range(count)]
    for page in opened:
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if "Content Security" in message.text else None)
    try:
        yield opened
    finally:
        with contextlib.suppress(Error):  # a test may have killed the browser
            context.close()
    assert errors == [], errors


@contextlib.contextmanager
def person(browser: Browser, address: str) -> Iterator[Page]:
    """A user with a separate browser context at an address."""
    with tabs(browser) as (page,):
        page.goto(address)
        yield page


@contextlib.contextmanager
def pages(browser: Browser, machine: Machine, count: int = 1) -> Iterator[list[Page]]:
    """Tabs of one session, on the device list."""
    with tabs(browser, count) as opened:
        for page in opened:
            page.goto(machine.sign_in_link() if page is opened[0] else machine.url)
            expect(page.get_by_test_id("signed-in")).to_be_visible()
        yield opened
