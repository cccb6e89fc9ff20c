"""A room transfer is offered, revoked, offered again, and accepted by another user in a second browser."""

from playwright.sync_api import Browser, Page, expect

from tests.harness.browser.browser import person
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Api, Machine
from tests.harness.browser.steering import open_robot

TO = "berta"
ROOM = "Annex"


def offer(page: Page, to: str) -> str:
    """Fill in the open form. Returns the link."""
    page.get_by_label("Account name").fill(to)
    page.get_by_test_id("transfer-send").click()
    expect(page.get_by_test_id("invitation-link")).to_be_visible()
    return page.get_by_test_id("invitation-link").input_value()


def rooms(machine: Machine, account: str) -> set[str]:
    with Api(machine, account) as api:
        return {space["name"] for space in api.get("/spaces")["items"] if space["role"] == "owner"}


def test_a_room_transfer_is_revoked_offered_again_and_accepted(browser: Browser, machine: Machine) -> None:
    with Api(machine) as api:
        room = api.post("/spaces", {"name": ROOM})["id"]
    theirs = machine.sign_in_link(TO)
    with person(browser, machine.sign_in_link()) as ann, person(browser, theirs) as berta:
        expect(ann.get_by_test_id("signed-in")).to_be_visible()
        expect(berta.get_by_test_id("signed-in")).to_be_visible()
        ann.goto(f"{machine.url}/#/spaces/{room}")
        ann.get_by_test_id("transfer").click()
        expect(ann.get_by_test_id("transfer-terms")).to_contain_text("you cannot undo the transfer")
        ann.get_by_label("Account name").fill("unknown account")
        ann.get_by_test_id("transfer-send").click()
        expect(ann.locator("#transfer-answer")).not_to_be_empty()
        expect(ann.get_by_label("Account name")).to_have_value("unknown account")  # the input stays
        assert_good_page(ann, "transfer", part="transfers")
        first = offer(ann, TO)
        ann.get_by_role("button", name="Done").click()
        expect(ann.get_by_test_id("transfer")).to_be_focused()
        expect(ann.get_by_test_id("offers")).to_contain_text(f"Offered to {TO}")
        assert_good_page(ann, "transfer-open", part="transfers")
        # The link of a revoked offer is invalid.
        ann.get_by_role("button", name=f"Revoke: Offered to {TO}").click()
        ann.get_by_test_id("confirm-yes").click()
        expect(ann.get_by_test_id("offers")).to_have_count(0)
        berta.goto(first)
        expect(berta.get_by_role("alert")).not_to_be_empty()
        expect(berta.get_by_test_id("accept")).to_have_count(0)
        # Offered again: the owner changes only on acceptance.
        ann.get_by_test_id("transfer").click()
        berta.goto(offer(ann, TO))
        expect(berta.get_by_test_id("terms")).to_contain_text("cannot undo this")
        expect(berta.get_by_role("heading", level=1)).to_contain_text(f"offers you the ownership of {ROOM}")
        assert_good_page(berta, "transfer-offered")
        assert ROOM in rooms(machine, "demo")
        berta.get_by_test_id("accept").click()
        berta.get_by_test_id("confirm-yes").click()
        expect(berta.get_by_role("heading", level=1)).to_have_text(f"You are the owner of {ROOM}.")
        assert ROOM in rooms(machine, TO)
        assert ROOM not in rooms(machine, "demo")


def test_the_header_fits_a_phone_and_the_title_names_the_page(browser: Browser, machine: Machine) -> None:
    with person(browser, machine.sign_in_link()) as ann:
        ann.set_viewport_size({"width": 390, "height": 844})
        parts = ann.get_by_role("navigation", name="Main navigation").get_by_role("link")
        expect(parts).to_have_text(
            ["Devices", "Movements", "Robot types", "Health", "Latency", "Timeline", "Administration"]
        )
        for part in parts.all():
            box = part.bounding_box()
            assert box is not None
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= 390, "a link is cut off"
        expect(ann).to_have_title("Devices · Telescope")
        parts.nth(3).click()
        expect(ann.get_by_role("heading", level=1)).to_have_text("Health")
        expect(parts.nth(3)).to_have_attribute("aria-current", "page")
        expect(ann).to_have_title("Health · Telescope")
        ann.goto(f"{machine.url}/#/")
        open_robot(ann)
        expect(ann).to_have_title("Universal Robots UR5 · Telescope")
        expect(ann.get_by_test_id("stop")).to_be_in_viewport()
        ann.get_by_test_id("page-explainer").locator("summary").click()
        expect(ann.get_by_test_id("page-explainer")).to_contain_text("stale")
        assert_good_page(ann, "device-explained", part="page-explainer")
