"""The administration page: a stopped worker appears with advice and disappears by itself."""

import os
import signal

from playwright.sync_api import Browser, expect

from tests.harness.browser.browser import PATIENCE_MS, pages
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine


def test_an_administrator_sees_a_stopped_worker_and_its_end(browser: Browser, machine: Machine) -> None:
    worker = machine.pid("function_app work")
    with pages(browser, machine) as (demo,):
        demo.get_by_role("link", name="Administration").click()
        overall = demo.get_by_test_id("overall")
        expect(overall).to_have_attribute("data-status", "ok", timeout=PATIENCE_MS)
        expect(demo.get_by_text("Connected agents")).to_be_visible()
        assert_good_page(demo, "administration")
        os.kill(worker, signal.SIGSTOP)
        try:
            expect(overall).to_have_attribute("data-status", "failed", timeout=PATIENCE_MS)
            part = demo.get_by_test_id("part-workers")
            expect(part).to_have_attribute("data-status", "failed", timeout=PATIENCE_MS)
            expect(part).to_contain_text("Restart the worker")
            assert_good_page(demo, "administration-failed")
        finally:
            os.kill(worker, signal.SIGCONT)
        expect(overall).to_have_attribute("data-status", "ok", timeout=PATIENCE_MS)


def test_other_accounts_neither_see_the_link_nor_the_page(browser: Browser, machine: Machine) -> None:
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(machine.sign_in_link("berta"))
        expect(page.get_by_test_id("signed-in")).to_have_text("berta")
        expect(page.get_by_role("link", name="Administration")).to_have_count(0)
        page.evaluate("() => { location.hash = '#/administration'; }")
        expect(page.get_by_text("Only administrators")).to_be_visible()
