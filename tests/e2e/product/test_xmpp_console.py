"""The console's sliders over XMPP, in Chromium with Prosody; the simulation trace is the measurement."""

import re
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from infra.prosody.configuration import PATH
from tests.harness.browser.browser import person
from tests.harness.browser.product import Machine, start_machine
from tests.harness.browser.steering import (
    assert_at_rest,
    drive,
    elbow,
    end_in_mid_motion,
    in_control,
    open_robot,
    operator,
    release_control,
    stopped_in_time,
    take_control,
)
from tests.harness.network.brokers import wait_until

KEEP_SOCKETS = """(() => {
    window.sockets = [];
    window.WebSocket = class extends window.WebSocket {
        constructor(...parts) { super(...parts); window.sockets.push(this); }
    };
})()"""
CLOSE_XMPP = "() => window.sockets.filter((each) => each.protocol === 'xmpp').forEach((each) => each.close())"
NOTE = """() => {
    window.noted = [];
    const record = () => {
        for (const id of ["stream-state", "setpoint-transport"])
            window.noted.push(document.querySelector(`[data-testid=${id}]`)?.textContent ?? "");
    };
    new MutationObserver(record).observe(document.body, {subtree: true, childList: true, characterData: true});
}"""
"""Records the state of the connection, which may recover before the test reads it."""
LOST = "No connection for setpoints: The connection to the XMPP server was lost."
POST = """([path, body, csrf]) => fetch('/api/v1' + path, {method: 'POST', body: JSON.stringify(body),
    headers: {'Content-Type': 'application/json', 'X-CSRF-Token': csrf}}).then(r => r.status)"""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    with start_machine(tmp_path_factory.mktemp("machine"), TELESCOPE_XMPP="1") as machine:
        assert machine.ready
        yield machine


def choose(page: Page, transport: str) -> None:
    page.get_by_test_id("transport-choice").get_by_label(transport).check()


def post(page: Page, path: str, body: dict[str, Any]) -> int:
    """Status of a direct request of the page's session."""
    csrf = page.evaluate("() => fetch('/api/v1/accounts/me').then(r => r.json())")["csrf_token"]
    return int(page.evaluate(POST, [path, body, csrf]))


def test_the_slider_moves_the_arm_over_xmpp_and_shows_it(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    sent: dict[str, list[str]] = {}

    def record(socket: Any) -> None:
        frames = sent.setdefault(socket.url, [])
        socket.on("framesent", lambda frame: frames.append(str(frame)))

    with operator(browser, machine) as page:
        choose(page, "XMPP")
        page.on("websocket", record)
        before = elbow(trace)
        drive(page, 0.4 if before > 0 else 0.6, lambda: abs(elbow(trace) - before) > 0.2, "the elbow")
        expect(page.get_by_test_id("setpoint-transport")).to_contain_text("XMPP, connected")
        release_control(page)
    # Only setpoints use XMPP, only this address is opened, and it contains no credentials.
    assert list(sent) == [f"ws://127.0.0.1:{machine.port + 4}{PATH}"]
    (frames,) = sent.values()
    topics = {found[1] for frame in frames if (found := re.search(r'topic="([^"]*)"', frame))}
    assert len(topics) == 1
    assert re.fullmatch(r"ts/v1/[^/]+/[^/]+/ur5/ctl/[0-9]+", topics.pop())


def test_a_page_without_control_moves_nothing(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    victor = machine.sign_in_link("victor")
    with machine.api() as api:
        device = api.free_device()
        api.post(f"/devices/{device['id']}/shares", {"account": "victor", "role": "viewer"})
    with operator(browser, machine) as ann, operator(browser, machine) as bob, person(browser, victor) as viewer:
        open_robot(viewer)
        for page in (ann, bob, viewer):
            choose(page, "XMPP")
        take_control(ann)
        rest = elbow(trace)
        with machine.api() as api:
            epoch = api.device()["lease"]["epoch"]
        control = {"purpose": "control", "device": device["id"], "epoch": epoch}
        for page, status in ((bob, 409), (viewer, 403)):
            expect(page.get_by_test_id("slider-elbow")).to_be_disabled()
            assert post(page, "/xmpp/credentials", control) == status
        assert_at_rest(trace)
        assert abs(elbow(trace) - rest) < 0.005
        assert in_control(ann)
        release_control(ann)


def test_a_closed_socket_stops_the_motion_and_the_page_says_so(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    with operator(browser, machine) as page:
        page.add_init_script(KEEP_SOCKETS)
        page.reload()
        choose(page, "XMPP")
        page.evaluate(NOTE)

        def attempt() -> float:
            moved_on_ms = end_in_mid_motion(page, trace, lambda: page.evaluate(CLOSE_XMPP))
            page.mouse.up()
            return moved_on_ms

        assert stopped_in_time(attempt)
        noted = page.evaluate("() => window.noted")
        assert any(LOST in text for text in noted), set(noted)
        assert any("XMPP, not connected" in text for text in noted), set(noted)

        # The same transport carries the next input; nothing has continued on MQTT.
        expect(page.get_by_test_id("setpoint-transport")).not_to_contain_text("MQTT")
        rest = elbow(trace)
        drive(page, 0.75 if rest < 0.5 else 0.25, lambda: abs(elbow(trace) - rest) > 0.1, "the next press")
        release_control(page)


def test_a_killed_xmpp_server_stops_the_motion_and_comes_back(browser: Browser, machine: Machine) -> None:
    trace = machine.trace()
    with operator(browser, machine) as page:
        choose(page, "XMPP")

        def attempt() -> float:
            moved_on_ms = end_in_mid_motion(page, trace, lambda: machine.kill("infra.prosody"))
            page.mouse.up()
            wait_until(lambda: "XMPP, connected" in (transport(page) or "") or not in_control(page), "the connection")
            return moved_on_ms

        assert stopped_in_time(attempt)
        rest = elbow(trace)
        drive(page, 0.75 if rest < 0.5 else 0.25, lambda: abs(elbow(trace) - rest) > 0.1, "the next press")
        release_control(page)


def transport(page: Page) -> str | None:
    return page.get_by_test_id("setpoint-transport").text_content()


def test_the_policy_of_the_page_allows_exactly_the_endpoint(machine: Machine) -> None:
    with machine.api() as api:
        policy = api.http.get("/health").headers["content-security-policy"]
    hosts = f"'self' ws://127.0.0.1:{machine.port + 2}/mqtt ws://127.0.0.1:{machine.port + 4}{PATH}"
    assert f"; connect-src {hosts};" in policy


def test_prosody_offers_browsers_only_the_websocket(machine: Machine) -> None:
    with machine.api() as api:
        for path, status in ((PATH, 200), ("/http-bind", 404), ("/file_share", 404)):
            answer = api.http.get(f"http://127.0.0.1:{machine.port + 4}{path}", headers={"Origin": "http://elsewhere"})
            assert answer.status_code == status, path
            assert "access-control-allow-origin" not in answer.headers
