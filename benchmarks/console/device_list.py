"""Device list with many devices: time to draw, time to search, and cost of one state message.

The devices are minimal agents without hardware or physics, so the measurement shows the cost of the page.
"""

import os
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Final

from playwright.sync_api import Browser, CDPSession, Page

from benchmarks.console.frames import TAKE_FRAMES, WATCH_FRAMES
from benchmarks.console.minimal_agents import pair_minimal_agents
from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.protocol import Mode, State, codec, topics
from tests.fakes.agent import Robot
from tests.harness.browser.browser import pages
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import wait_until

OWN: Final = 1
"""The list also contains the product's own arm."""
DRAWN_WITHIN_MS: Final = 1000.0
FILTERED_WITHIN_MS: Final = 100.0
"""Limit from a key press to the result of the search [ms]."""
WORD_MS: Final = 5.0
"""Limit per state message [ms]: 200 devices with one message per second each would otherwise occupy the page."""
LISTENS_S: Final = 10.0
SAID_HZ: Final = 20.0
"""State messages per second of all devices: three times the rate of devices without changes (one per 30 s)."""
_SEARCHES: Final = ("7", "ur5", "device 1", "device 13", "nothing like it", "")

# From navigation to the last row, after layout and paint.
_OPEN: Final = """(count) => new Promise((resolve) => {
    const began = performance.now();
    const look = () => {
        const rows = document.querySelectorAll("[data-testid=device-row]");
        if (rows.length < count) requestAnimationFrame(look);
        else requestAnimationFrame(() => setTimeout(() => resolve(performance.now() - began)));
    };
    location.hash = "#/";
    look();
})"""
_SEARCH: Final = """(words) => new Promise((resolve) => {
    const field = document.querySelector("[data-testid=search]");
    field.value = words;
    const began = performance.now();
    field.dispatchEvent(new Event("input", {bubbles: true}));
    requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(() => resolve(performance.now() - began))));
})"""
_ONLINE: Final = "() => document.querySelectorAll('[data-testid=device-row] [data-status=online]').length"


def speak(robot: Robot, name: str, mode: Mode) -> None:
    """Publishes the state of one device."""
    state = State(device=name, at_ms=wall_ms(), tick_ms=tick_ms(), mode=mode, epoch=0)
    if robot.link is None:
        raise RuntimeError("the agent has not connected")
    robot.link.publish(robot.topic(topics.STATE, name), codec.encode(state), retain=True)


def show_list(browser: Browser, machine: Machine, count: int) -> bool:
    """Measures the list and returns True if it is drawn and searched within the limits."""
    with pair_minimal_agents(machine, count) as robots, pages(browser, machine) as (page,):
        everyone = [(robot, name) for robot in robots for name in robot.names]
        for robot, name in everyone:
            speak(robot, name, Mode.IDLE)
        page.reload()
        expected = count + OWN
        wait_until(lambda: page.evaluate(_ONLINE) >= count, "every device to be heard", 120)
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")
        print(f"{expected} devices behind {len(robots) + 1} agents; load {os.getloadavg()[0]:.1f}")
        drawn_ms = _opened(page, expected)
        filtered_ms = [page.evaluate(_SEARCH, words) for words in _SEARCHES]
        rest_ms = _busy_ms(session, lambda: page.wait_for_timeout(1000 * LISTENS_S))
        said = 0

        def all_speak() -> None:
            nonlocal said
            until_s = time.monotonic() + LISTENS_S
            while time.monotonic() < until_s:
                robot, name = everyone[said % count]
                speak(robot, name, Mode.STREAMING if (said // count) % 2 == 0 else Mode.IDLE)
                said += 1
                page.wait_for_timeout(1000 / SAID_HZ)

        page.evaluate(WATCH_FRAMES)
        word_ms = (_busy_ms(session, all_speak) - rest_ms) / said
        longest_ms = max(page.evaluate(TAKE_FRAMES)["gaps"])
    return _verdict(drawn_ms, filtered_ms, word_ms, rest_ms, longest_ms)


def _opened(page: Page, count: int) -> float:
    """Returns the time to draw the list after navigation from another page, median of five [ms]."""
    found: list[float] = []
    for _ in range(5):
        page.evaluate("() => { location.hash = '#/robot-types'; }")
        wait_until(lambda: page.get_by_test_id("device-row").count() == 0, "another page", 30)
        found.append(page.evaluate(_OPEN, count))
    return statistics.median(found)


def _busy_ms(session: CDPSession, what: Callable[[], None]) -> float:
    """Returns the time that the page's main thread is busy during a call [ms]."""

    def busy() -> float:
        metrics = {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}
        return 1000 * float(metrics["TaskDuration"])

    before = busy()
    what()
    return busy() - before


def _verdict(drawn_ms: float, filtered_ms: Sequence[float], word_ms: float, rest_ms: float, longest_ms: float) -> bool:
    rows = (
        ("the list is drawn, median of 5", drawn_ms, DRAWN_WITHIN_MS),
        ("a search is drawn, the slowest", max(filtered_ms), FILTERED_WITHIN_MS),
        ("one word of a device", word_ms, WORD_MS),
    )
    for what, took, most in rows:
        print(f"{what:32}{took:9.1f} ms, {'within' if took <= most else 'MORE THAN'} {most:.0f} ms")
    print(f"each search: {', '.join(f'{each:.0f}' for each in filtered_ms)} ms")
    print(f"nothing said: the page is at work {rest_ms / (10 * LISTENS_S):.1f} % of the time")
    print(f"{SAID_HZ:.0f} words a second: longest frame {longest_ms:.0f} ms; load {os.getloadavg()[0]:.1f}")
    return all(took <= most for _, took, most in rows)
