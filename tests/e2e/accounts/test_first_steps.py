"""A new user signs in, has no devices, and sees the first steps."""

from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import person
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine


def test_a_new_user_sees_the_first_steps(browser: Browser, machine: Machine) -> None:
    with person(browser, machine.url) as page:
        expect(page.get_by_role("heading", name="Sign in")).to_be_visible()
        assert_good_page(page, "sign-in")

        page.goto(machine.sign_in_link("newcomer"))
        expect(page.get_by_test_id("signed-in")).to_be_visible()
        steps = page.get_by_test_id("first-steps")
        expect(steps).to_contain_text("Pair it")
        assert command(page, "enroll").endswith(f"--server {machine.url} --device arm=ur5 --no-wait")
        assert command(page, "run") == "python -m device_agent run --home ~/arm-agent"
        page.get_by_test_id("page-explainer").get_by_text("About this page").click()
        expect(page.get_by_text("One operator at a time has control")).to_be_visible()
        assert_good_page(page, "first-steps")

        page.goto(f"{machine.url}/#/account")
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        assert_good_page(page, "account")


def command(page: Page, name: str) -> str:
    return page.get_by_test_id(f"command-{name}").input_value()
