"""Sign-in in Chromium: by password, and at an OpenID Connect provider of another site."""

from collections.abc import Iterator

import pyotp
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import person
from tests.harness.browser.pages import assert_good_page
from tests.harness.cloud.oidc_provider import CLIENT_ID, CLIENT_SECRET, new_key, start_provider
from tests.harness.cloud.people import sign_in_link
from tests.harness.hosts.host import environment_of, start_program
from tests.harness.hosts.uvicorn import _listens
from tests.harness.network.brokers import wait_until
from tests.harness.network.ports import free_port

PASSWORD = "correct horse battery"


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Settings of functions at ``localhost`` with a provider at ``127.0.0.1``; a browser treats these as two sites."""
    port = free_port()
    home = tmp_path_factory.mktemp("sign-in")
    url = f"http://localhost:{port}"
    with start_provider([new_key()], redirect=f"{url}/api/v1/auth/oidc/callback") as issuer:
        settings = {
            "TELESCOPE_HOME": str(home),
            "TELESCOPE_HOST": "127.0.0.1",
            "TELESCOPE_PORT": str(port),
            "TELESCOPE_MQTT_PORT": "1",
            "TELESCOPE_PUBLIC_URL": url,
            "TELESCOPE_OIDC_ISSUER": issuer,
            "TELESCOPE_OIDC_CLIENT_ID": CLIENT_ID,
            "TELESCOPE_OIDC_CLIENT_SECRET": CLIENT_SECRET,
            "TELESCOPE_OIDC_NAME": "the lab",
            "TELESCOPE_OIDC_ACCOUNTS": "anyone",
        }
        with start_program(["-m", "function_app", "serve"], environment_of(settings)) as server:
            wait_until(lambda: _listens(port) or server.process.poll() is not None, "the server")
            assert server.process.poll() is None, server.stderr()
            yield settings


def signed_in(page: Page, name: str) -> None:
    expect(page.get_by_test_id("signed-in")).to_have_text(name)


def sign_in_at_the_provider(page: Page, name: str) -> None:
    page.get_by_test_id("sign-in-provider").click()
    page.locator("input[name=login]").fill(name)
    page.locator("input[name=password]").fill("any")
    page.locator("button[type=submit]").click()
    page.locator("button[type=submit]").click()
    signed_in(page, f"Name of {name}")


def test_a_password_is_set_after_a_link_and_signs_in(browser: Browser, environment: dict[str, str]) -> None:
    url = environment["TELESCOPE_PUBLIC_URL"]
    with person(browser, f"{url}/#sign-in={sign_in_link(environment, 'ann')}") as page:
        signed_in(page, "ann")
        page.get_by_test_id("signed-in").click()
        page.get_by_label("New password").fill(PASSWORD)
        page.get_by_role("button", name="Set password").click()
        expect(page.get_by_text("Password set.")).to_be_visible()
    with person(browser, url) as page:
        page.get_by_test_id("sign-in-name").fill("ann")
        page.get_by_test_id("sign-in-password").fill("another one")
        page.get_by_test_id("sign-in").click()
        expect(page.get_by_text("Name or password is wrong")).to_be_visible()
        page.get_by_test_id("sign-in-password").fill(PASSWORD)
        page.get_by_test_id("sign-in").click()
        signed_in(page, "ann")


def test_a_second_factor_is_added_and_required(browser: Browser, environment: dict[str, str]) -> None:
    url = environment["TELESCOPE_PUBLIC_URL"]
    with person(browser, f"{url}/#sign-in={sign_in_link(environment, 'fay')}") as page:
        signed_in(page, "fay")
        page.get_by_test_id("signed-in").click()
        page.get_by_test_id("add-factor").click()
        page.get_by_test_id("factor-continue").click()  # no password is needed shortly after a link
        secret = page.get_by_test_id("factor-secret").inner_text().replace(" ", "")
        assert_good_page(page, "second-factor", part="second-factor")
        page.get_by_test_id("new-factor-code").fill("000000")
        page.get_by_test_id("new-factor-code-submit").click()
        expect(page.get_by_text("The code is wrong")).to_be_visible()
        page.get_by_test_id("new-factor-code").fill(pyotp.TOTP(secret).now())
        page.get_by_test_id("new-factor-code-submit").click()
        codes = page.get_by_test_id("recovery-codes").locator("code")
        expect(codes).to_have_count(10)
        recovery = codes.all_inner_texts()
        assert_good_page(page, "recovery-codes", part="second-factor")
        page.get_by_test_id("codes-saved").click()
        expect(page.get_by_test_id("second-factor")).to_contain_text("10 unused recovery codes")
    with person(browser, f"{url}/#sign-in={sign_in_link(environment, 'fay')}") as page:
        expect(page.get_by_test_id("sign-in-code")).to_be_visible()
        assert_good_page(page, "sign-in-code")
        page.get_by_test_id("sign-in-code").fill(recovery[0])
        page.get_by_test_id("sign-in-code-submit").click()
        signed_in(page, "fay")


def test_a_sign_in_of_an_unknown_browser_is_reported_and_can_be_ended(
    browser: Browser, environment: dict[str, str]
) -> None:
    url = environment["TELESCOPE_PUBLIC_URL"]
    with person(browser, f"{url}/#sign-in={sign_in_link(environment, 'gus')}") as page:
        signed_in(page, "gus")
        with person(browser, f"{url}/#sign-in={sign_in_link(environment, 'gus')}") as other:
            signed_in(other, "gus")
            page.reload()
            expect(page.get_by_test_id("sign-in-notice")).to_contain_text("from 127.0.0.1, with Chrome")
            page.get_by_test_id("sign-in-notice").get_by_role("link").click()
            assert_good_page(page, "new-sign-in")
            page.get_by_test_id("sessions").get_by_role("button", name="End the session").click()
            expect(page.get_by_test_id("sessions").locator("li")).to_have_count(1)
            other.reload()
            expect(other.get_by_test_id("sign-in-name")).to_be_visible()
        page.get_by_test_id("sign-in-confirm").click()
        expect(page.get_by_test_id("sign-in-notice")).to_have_count(0)
        page.reload()
        signed_in(page, "gus")
        expect(page.get_by_test_id("sessions").locator("li")).to_have_count(1)
        expect(page.get_by_test_id("sign-in-notice")).to_have_count(0)


def test_sign_in_at_a_provider_returns_with_a_lasting_session(browser: Browser, environment: dict[str, str]) -> None:
    """Only a browser can show that the strict cookie set by the redirect is stored."""
    with person(browser, environment["TELESCOPE_PUBLIC_URL"]) as page:
        sign_in_at_the_provider(page, "bob")
        page.reload()
        signed_in(page, "Name of bob")
        cookies = {each["name"]: each for each in page.context.cookies(f"{environment['TELESCOPE_PUBLIC_URL']}/api/v1")}
        assert cookies["telescope_session"]["sameSite"] == "Strict"
        assert cookies["telescope_session"]["httpOnly"] is True


def test_sign_in_at_a_provider_returns_to_the_invitation(browser: Browser, environment: dict[str, str]) -> None:
    url = environment["TELESCOPE_PUBLIC_URL"]
    with (
        person(browser, f"{url}/#sign-in={sign_in_link(environment, 'dora')}") as owner,
        person(browser, "about:blank") as page,
    ):
        owner.get_by_test_id("space-link").click()
        owner.get_by_test_id("invite").click()
        owner.get_by_test_id("invite-send").click()
        page.goto(owner.get_by_test_id("invitation-link").input_value())
        sign_in_at_the_provider(page, "eve")
        expect(page.get_by_test_id("shared-with-me")).to_contain_text("Home")
        page.reload()
        signed_in(page, "Name of eve")
        expect(page.get_by_test_id("shared-with-me")).to_have_count(0)  # the accepted invitation is not shown again
