"""Two users in two browsers share an arm by link and revoke access; API keys and the audit log."""

import httpx
from playwright.sync_api import Browser, expect

from tests.harness.browser.browser import person
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.browser.steering import move_the_elbow, open_robot

PASSWORD = "seven quiet robots wave"


def test_an_invited_user_moves_the_arm_until_the_owner_revokes_access(browser: Browser, machine: Machine) -> None:
    with person(browser, machine.sign_in_link()) as ann:
        open_robot(ann)
        ann.get_by_test_id("invite").click()
        ann.get_by_test_id("invite-send").click()
        link = ann.get_by_test_id("invitation-link").input_value()
        assert_good_page(ann, "sharing-link", part="access")
        with person(browser, link) as bob:
            assert link.partition("=")[2] not in bob.url, "the secret is removed from the address"
            expect(bob.get_by_test_id("join")).to_be_visible()
            assert_good_page(bob, "invited")
            bob.get_by_label("Your name").fill("Bob")
            bob.get_by_label("Choose a password").fill("password1234")
            bob.get_by_test_id("join").click()
            expect(bob.locator("#join-answer")).not_to_be_empty()
            expect(bob.get_by_label("Your name")).to_have_value("Bob")  # the input stays
            bob.get_by_label("Choose a password").fill(PASSWORD)
            bob.get_by_test_id("join").click()
            bob.get_by_test_id("shared-with-me").get_by_role("link", name="UR5").click()
            move_the_elbow(bob, machine)
            row = ann.get_by_test_id("person").filter(has_text="Bob")
            expect(row).to_contain_text("Operator")
            ann.get_by_role("button", name="Done").click()
            expect(ann.get_by_test_id("invite")).to_be_focused()  # keyboard users continue from here
            ann.get_by_test_id("invite").click()
            ann.get_by_role("button", name="Change the access of Bob").click()
            assert_good_page(ann, "sharing", part="access")
            row.get_by_test_id("remove").click()
            expect(bob.get_by_test_id("no-access")).to_contain_text("no longer have access")
            assert_good_page(bob, "access-ended")
            # Undo restores access; the second removal is final.
            ann.get_by_test_id("undo").click()
            expect(bob.get_by_test_id("control-state")).to_be_visible()
            row.get_by_test_id("remove").click()
            expect(bob.get_by_test_id("no-access")).to_be_visible()
            expect(row).to_have_count(0)


def test_an_api_key_is_created_used_revoked_and_audited(browser: Browser, machine: Machine) -> None:
    with person(browser, machine.sign_in_link()) as ann:
        expect(ann.get_by_test_id("device-row").first).to_be_visible()
        ann.get_by_test_id("signed-in").click()
        ann.get_by_test_id("new-key").click()
        ann.get_by_label("Description").fill("night shift")
        ann.get_by_label("Selected devices and spaces").check()
        ann.get_by_test_id("make-key").click()
        expect(ann.get_by_text("Choose at least one")).to_be_visible()
        ann.get_by_label("UR5").check()
        assert_good_page(ann, "keys-new")
        ann.get_by_test_id("make-key").click()
        token = ann.get_by_test_id("api-key-token").input_value()
        assert_good_page(ann, "keys")
        with httpx.Client(base_url=f"{machine.url}/api/v1", headers={"Authorization": f"Bearer {token}"}) as program:
            (seen,) = program.get("/devices").json()["items"]
            assert seen["role"] == "viewer"
            ann.reload()
            key = ann.get_by_test_id("key").filter(has_text="night shift")
            expect(key).to_contain_text("only Universal Robots UR5")
            expect(key).to_contain_text("last used")
            assert ann.get_by_test_id("api-key-token").count() == 0, "the token must be displayed once only"
            key.get_by_test_id("revoke-key").click()
            key.get_by_test_id("confirm-yes").click()
            expect(key).to_have_count(0)
            assert program.get("/devices").status_code == httpx.codes.UNAUTHORIZED
        ann.get_by_role("link", name="View audit log").click()
        audit = ann.get_by_test_id("audit")
        expect(audit).to_contain_text("revoked the API key “night shift”")
        expect(audit).to_contain_text("created the API key “night shift”: viewer, only Universal Robots UR5")
        assert_good_page(ann, "activity")
        ann.get_by_test_id("audit-event").select_option("api-key-made")
        expect(audit.locator("li[data-event='api-key-revoked']")).to_have_count(0)
        expect(audit.locator("li[data-event='api-key-made']").first).to_be_visible()
        ann.goto(f"{machine.url}/#/")
        expect(ann.get_by_test_id("space-link").first).to_be_visible()
        assert_good_page(ann, "devices")
        ann.get_by_test_id("space-link").first.click()
        expect(ann.get_by_test_id("people")).to_be_visible()
        assert_good_page(ann, "space")
