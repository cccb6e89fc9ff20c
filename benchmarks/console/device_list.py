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
MESSAGE_MS: Final = 5.0
"""Limit per state message [ms]: 200 devices with one message per second each would otherwise occupy the page."""
OBSERVED_S: Final = 10.0
STATE_HZ: Final = 20.0
"""State messages per second of all devices: three times the rate of devices without changes (one per 30 s)."""
_SEARCHES: Final = ("7", "ur5", "device 1", "device 13", "no match", "")

# From navigation to the last row, after layout and paint.
_OPEN: Final = """(count) => new Promise((resolve) => {
    const start = performance.now();
    const check = () => {
        const rows = document.querySelectorAll("[data-testid=device-row]");
        if (rows.length < count) requestAnimationFrame(check);
        else requestAnimationFrame(() => setTimeout(() => resolve(performance.now() - start)));
    };
    location.hash = "#/";
    check();
})"""
_SEARCH: Final = """(words) => new Promise((resolve) => {
    const field = document.querySelector("[data-testid=search]");
    field.value = words;
    const start = performance.now();
    field.dispatchEvent(new Event("input", {bubbles: true}));
    requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(() => resolve(performance.now() - start))));
})"""
_ONLINE: Final = "() => document.querySelectorAll('[data-testid=device-row] [data-status=online]').length"


def publish_state(robot: Robot, name: str, mode: Mode) -> None:
    """Publishes the state of one device."""
    state = State(device=name, at_ms=wall_ms(), tick_ms=tick_ms(), mode=mode, epoch=0)
    if robot.link is None:
        raise RuntimeError("the agent has not connected")
    robot.link.publish(robot.topic(topics.STATE, name), codec.encode(state), retain=True)


def measure_list(browser: Browser, machine: Machine, count: int) -> bool:
    """Measures the list and returns True if it is drawn and searched within the limits."""
    with pair_minimal_agents(machine, count) as robots, pages(browser, machine) as (page,):
        devices = [(robot, name) for robot in robots for name in robot.names]
        for robot, name in devices:
            publish_state(robot, name, Mode.IDLE)
        page.reload()
        expected = count + OWN
        wait_until(lambda: page.evaluate(_ONLINE) >= count, "every device to be online", 120)
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")
        print(f"{expected} devices behind {len(robots) + 1} agents; load {os.getloadavg()[0]:.1f}")
        drawn_ms = _open_ms(page, expected)
        filtered_ms = [page.evaluate(_SEARCH, words) for words in _SEARCHES]
        idle_ms = _busy_ms(session, lambda: page.wait_for_timeout(1000 * OBSERVED_S))
        published = 0

        def publish_all() -> None:
            nonlocal published
            until_s = time.monotonic() + OBSERVED_S
            while time.monotonic() < until_s:
                robot, name = devices[published % count]
                publish_state(robot, name, Mode.STREAMING if (published // count) % 2 == 0 else Mode.IDLE)
                published += 1
                page.wait_for_timeout(1000 / STATE_HZ)

        page.evaluate(WATCH_FRAMES)
        message_ms = (_busy_ms(session, publish_all) - idle_ms) / published
        longest_ms = max(page.evaluate(TAKE_FRAMES)["gaps"])
    return _report(drawn_ms, filtered_ms, message_ms, idle_ms, longest_ms)


def _open_ms(page: Page, count: int) -> float:
    """Returns the time to draw the list after navigation from another page, median of five [ms]."""
    durations_ms: list[float] = []
    for _ in range(5):
        page.evaluate("() => { location.hash = '#/robot-types'; }")
        wait_until(lambda: page.get_by_test_id("device-row").count() == 0, "another page", 30)
        durations_ms.append(page.evaluate(_OPEN, count))
    return statistics.median(durations_ms)


def _busy_ms(session: CDPSession, call: Callable[[], None]) -> float:
    """Returns the time that the page's main thread is busy during a call [ms]."""

    def busy() -> float:
        metrics = {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}
        return 1000 * float(metrics["TaskDuration"])

    before = busy()
    call()
    return busy() - before


def _report(drawn_ms: float, filtered_ms: Sequence[float], message_ms: float, idle_ms: float, frame_ms: float) -> bool:
    rows = (
        ("drawing the list, median of 5", drawn_ms, DRAWN_WITHIN_MS),
        ("drawing a search, slowest", max(filtered_ms), FILTERED_WITHIN_MS),
        ("one state message", message_ms, MESSAGE_MS),
    )
    for name, measured_ms, limit_ms in rows:
        print(
            f"{name:32}{measured_ms:9.1f} ms, {'within' if measured_ms <= limit_ms else 'MORE THAN'} {limit_ms:.0f} ms"
        )
    print(f"each search: {', '.join(f'{each:.0f}' for each in filtered_ms)} ms")
    print(f"without messages, the page is busy {idle_ms / (10 * OBSERVED_S):.1f} % of the time")
    print(f"{STATE_HZ:.0f} messages per second: longest frame {frame_ms:.0f} ms; load {os.getloadavg()[0]:.1f}")
    return all(measured_ms <= limit_ms for _, measured_ms, limit_ms in rows)
