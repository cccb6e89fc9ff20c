"""A user pairs a robot with the link that its agent prints, and sets its name and room."""

import codecs
import contextlib
import os
import pty
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from device_agent.cli import claim_prompt
from tests.harness.browser.browser import person
from tests.harness.browser.pages import assert_good_page
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT


class Terminal:
    """An enrolling agent in a pseudo-terminal, and its output."""

    def __init__(self, machine: Machine, home: Path) -> None:
        self.text = ""
        ours, theirs = pty.openpty()
        command = [
            *(sys.executable, "-m", "device_agent", "enroll", "--server", machine.url, "--home", str(home)),
            *("--name", "visitor", "--device", "visitor=ur5"),
        ]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=theirs, stdout=theirs, stderr=theirs, env=os.environ | {"COLUMNS": "80"}
        )
        os.close(theirs)
        self._ours = ours
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # its end
            decoder = codecs.getincrementaldecoder("utf-8")()
            while output := os.read(self._ours, 4096):
                self.text += decoder.decode(output)

    def link(self) -> str:
        def pairing_link() -> re.Match[str] | None:
            return re.search(r"(http\S+#pair=\S+)\s", self.text)

        wait_until(lambda: pairing_link() is not None, "the link")
        match = pairing_link()
        assert match
        return match[1]

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        self.process.wait(20)
        self._reader.join(10)
        os.close(self._ours)


@pytest.fixture
def terminal(machine: Machine, tmp_path: Path) -> Iterator[Terminal]:
    terminal = Terminal(machine, tmp_path)
    yield terminal
    terminal.close()


def field(page: Page) -> str:
    return page.get_by_test_id("claim-code").input_value()


def test_a_robot_is_paired_by_the_link_in_the_terminal(browser: Browser, machine: Machine, terminal: Terminal) -> None:
    link = terminal.link()
    # The terminal also shows the link as a QR code.
    drawn = claim_prompt.qr_lines(link)
    wait_until(lambda: all(line in terminal.text for line in drawn), "the QR code")
    with machine.api() as api, person(browser, link) as page:
        existing = {device["id"] for device in api.get("/devices")["items"]}
        # Without a session the code is removed from the address and restored after sign-in. Claiming needs a click.
        expect(page.get_by_text("You followed a pairing link. Sign in to continue")).to_be_visible()
        assert "pair=" not in page.url
        page.goto(machine.sign_in_link())
        expect(page.get_by_test_id("claim-code")).to_have_value(link.partition("=")[2])
        assert {device["id"] for device in api.get("/devices")["items"]} == existing
        assert_good_page(page, "pairing")

        # A wrong code is rejected with a message; the form keeps its input.
        right = field(page)
        page.get_by_test_id("claim-code").fill("bcdf")
        page.get_by_test_id("claim").click()
        expect(page.get_by_role("alert")).to_contain_text("eight letters")
        page.get_by_test_id("claim-code").fill("zzzz zzzz")
        page.get_by_test_id("claim-space").select_option("new")
        page.get_by_label("Space name").fill("Guest room")
        page.get_by_test_id("claim").press("Enter")
        expect(page.get_by_role("alert")).to_contain_text("Pairing failed")
        assert field(page) == "zzzz zzzz"
        assert page.get_by_test_id("claim-space").locator("option:checked").inner_text() == "Guest room"
        assert_good_page(page, "pairing-wrong")

        page.get_by_test_id("claim-code").fill(right)
        page.get_by_test_id("claim").press("Enter")
        expect(page.get_by_test_id("paired")).to_be_visible()
        assert terminal.process.wait(30) == 0
        assert "paired with demo #" in terminal.text
        row = page.get_by_test_id("paired-device")
        expect(row).to_contain_text("Guest room")
        expect(row).to_contain_text("Waiting for the first data")
        spaces = [space["name"] for space in api.get("/spaces")["items"]]
        assert spaces.count("Guest room") == 1, "the second attempt must use the space of the first"

        # Rename it, then reset the name.
        before = row.get_by_role("link").inner_text()
        row.get_by_test_id("rename").press("Enter")
        row.get_by_test_id("name").fill("Visitor")
        assert_good_page(page, "paired")
        row.get_by_test_id("save-name").press("Enter")
        expect(row.get_by_role("link")).to_have_text("Visitor")
        row.get_by_test_id("undo-name").press("Enter")
        expect(row.get_by_role("link")).to_have_text(before)

        # A used code is invalid.
        page.get_by_role("button", name="Pair another").click()
        page.get_by_test_id("claim-code").fill(right)
        page.get_by_test_id("claim").click()
        expect(page.get_by_role("alert")).to_contain_text("already used")
        (paired,) = [device for device in api.get("/devices")["items"] if device["id"] not in existing]
        api.http.delete(f"/agents/{paired['agent']}").raise_for_status()
