"""Latency of the console in Chromium, from a slider press to simulated motion and back.

``python -m benchmarks.console.slider [--samples 40]`` presses the slider of a joint and takes timestamps on the clock
of the machine: press, published setpoint, command at the simulation, first motion of the simulated joint, telemetry
received by the page, and drawn twin. Each press compares the clock of the page with the clock of the machine.

``--fleet [--minutes 10]`` measures ten arms on one page (``frames.py``); ``--devices 200`` measures the device list
(``device_list.py``).
"""

import argparse
import os
import platform
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from playwright.sync_api import Page, expect, sync_playwright

from benchmarks.console.device_list import measure_list
from benchmarks.console.frames import measure_fleet
from tests.harness.browser.browser import PATIENCE_MS, chromium, pages
from tests.harness.browser.product import Machine, Trace, start_machine
from tests.harness.network.brokers import wait_until

JOINT: Final = "elbow"
PARTS: Final = ("input", "published", "commanded", "moved", "received", "drawn")
"""Parts in order: handled by the page, published, at the simulation, moving, telemetry received, drawn."""
MAX_MEDIAN_MS: Final = 60.0
"""Target for the median from press to simulated motion [ms]."""
MOVING_RAD_S: Final = 0.002
"""Velocity above which a simulated joint counts as moving: 0.1 °/s."""

# Observes the page from outside; its messages and drawing stay unchanged.
WATCH: Final = """() => {
    const at = () => performance.timeOrigin + performance.now();
    const marks = (window.benchMarks = {});
    const first = (name) => { if (marks.pressed !== undefined && marks[name] === undefined) marks[name] = at(); };
    const text = (data) => new TextDecoder("latin1").decode(data);
    const Native = window.WebSocket;
    window.WebSocket = class extends Native {
        constructor(...args) {
            super(...args);
            this.addEventListener("message", ({data}) => {
                if (!(data instanceof ArrayBuffer) || !marks.published || marks.received) return;
                const packet = text(data);
                if (!packet.includes("/tele/joints")) return;
                const speeds = /"velocity_rad_s":\\[([^\\]]*)\\]/.exec(packet);
                if (speeds === null || !speeds[1].split(",").some((each) => Math.abs(Number(each)) > MOVING)) return;
                first("received");
            });
        }
        send(data) {
            if (marks.pressed !== undefined && text(data).includes("/ctl/")) first("published");
            super.send(data);
        }
    };
    addEventListener("pointerdown", (event) => {
        if (marks.armed) marks.pressed = performance.timeOrigin + event.timeStamp;
    }, {capture: true});
    addEventListener("input", () => first("input"), {capture: true});
    window.benchDrawn = () => {
        const box = document.querySelector("[data-testid=view-3d]");
        const drawn = () => { if (marks.received !== undefined) first("drawn"); };
        new MutationObserver(drawn).observe(box, {attributeFilter: ["data-frames"]});
    };
    window.benchArm = () => {
        for (const name of Object.keys(marks)) delete marks[name];
        marks.armed = true;
        let offset = Infinity;
        for (let tries = 0; tries < 2000; tries += 1) offset = Math.min(offset, at() - Date.now());
        marks.offset = offset;
    };
}"""


@dataclass(frozen=True)
class Press:
    """One press of a slider; ``at_ms``: part → time after the press [ms]."""

    at_ms: dict[str, float]


def watch(page: Page) -> None:
    """Installs the observer; it is active from the next page load."""
    page.add_init_script(f"({WATCH.replace('MOVING', str(MOVING_RAD_S))})()")


def presses(page: Page, machine: Machine, count: int) -> list[Press]:
    """Presses the slider of a controlled arm repeatedly and returns one result per press.

    A press is repeated if the machine was too busy and the robot had to hold.
    """
    trace = machine.trace()
    page.evaluate("() => benchDrawn()")
    slider = page.get_by_test_id(f"slider-{JOINT}")
    slider.scroll_into_view_if_needed()
    results: list[Press] = []
    for index in range(3 * count):
        if len(results) == count:
            break
        _acquire_control(page)
        wait_until(lambda: _speed(trace) < MOVING_RAD_S, "rest", 20)
        page.wait_for_timeout(
            300 + 37 * (index % 7)
        )  # a robot at rest publishes every 50 ms; sample every phase of that period
        if (press := _press(page, trace, 0.55 if index % 2 else 0.6)) is not None:
            results.append(press)
    return results


def _acquire_control(page: Page) -> None:
    """Acquires control again if late setpoints on a busy machine ended the lease."""
    state, slider = page.get_by_test_id("control-state"), page.get_by_test_id(f"slider-{JOINT}")

    def is_controlled() -> bool:
        button = page.get_by_test_id("take-control")
        if state.get_attribute("data-state") != "mine" and button.count() and button.is_enabled():
            button.click()
            page.wait_for_timeout(300)
        return slider.is_enabled()

    wait_until(is_controlled, "control", 60)


def _press(page: Page, trace: Trace, share: float) -> Press | None:
    box = page.get_by_test_id(f"slider-{JOINT}").bounding_box()
    if box is None:
        return None
    page.mouse.move(box["x"] + box["width"] * share, box["y"] + box["height"] / 2)
    page.evaluate("() => benchArm()")
    before = trace.now()
    page.mouse.down()
    page.mouse.up()
    marks: dict[str, float] = {}

    def is_complete() -> bool:
        marks.update(page.evaluate("() => benchMarks"))
        return "drawn" in marks

    try:
        wait_until(is_complete, "the twin to be drawn", 5)
    except AssertionError:
        return None
    page.wait_for_timeout(100)
    at: dict[str, float] = {name: marks[name] - marks["offset"] for name in marks if name not in ("offset", "armed")}
    rows = [row for row in trace.rows() if row["tick_ms"] > before["tick_ms"]]
    commanded = next((row for row in rows if row["target"][JOINT] != before["target"][JOINT]), None)
    moved = next((row for row in rows if abs(row["qvel"][JOINT]) > MOVING_RAD_S), None)
    if commanded is None or moved is None:
        return None
    at |= {"commanded": commanded["at_ms"], "moved": moved["at_ms"]}
    return Press({part: at[part] - at["pressed"] for part in PARTS})


def _speed(trace: Trace) -> float:
    return abs(float(trace.now()["qvel"][JOINT]))


def show(results: Sequence[Press]) -> bool:
    """Prints the result and returns True if the target is met."""
    print(f"{platform.python_version()}, {os.cpu_count()} cores, {len(results)} presses of the slider of {JOINT}")
    print(f"{'ms':14}{'since the press: p50':>22}{'p95':>8}{'max':>8}{'since the previous part: p50':>30}")
    before = "pressed"
    for part in PARTS:
        times = sorted(press.at_ms[part] for press in results)
        step = [press.at_ms[part] - press.at_ms.get(before, 0.0) for press in results]
        percentiles = (statistics.median(times), times[round((len(times) - 1) * 0.95)], times[-1])
        print(
            f"{part:14}{percentiles[0]:22.1f}{percentiles[1]:8.1f}{percentiles[2]:8.1f}{statistics.median(step):30.1f}"
        )
        before = part
    median = statistics.median(press.at_ms["moved"] for press in results)
    reached = median <= MAX_MEDIAN_MS
    print(f"slider to simulated motion: {median:.1f} ms, {'within' if reached else 'MORE THAN'} {MAX_MEDIAN_MS:.0f} ms")
    return reached


def main() -> int:
    """Runs the command line."""
    parser = argparse.ArgumentParser(description="Measure the latency of the console.")
    parser.add_argument("--samples", type=int, default=40)
    parser.add_argument("--fleet", action="store_true", help="ten arms on one page")
    parser.add_argument("--minutes", type=float, default=10.0, help="with --fleet: duration of the memory measurement")
    parser.add_argument("--devices", type=int, default=0, help="measure a list with this number of devices")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ts-bench-console-") as name:
        folder = Path(name)
        with (
            start_machine(folder / "machine") as machine,
            sync_playwright() as playwright,
            chromium(playwright) as browser,
        ):
            if chosen.fleet:
                return 0 if measure_fleet(browser, machine, chosen.minutes) else 1
            if chosen.devices:
                return 0 if measure_list(browser, machine, chosen.devices) else 1
            with pages(browser, machine) as (page,):
                results = measure(page, machine, chosen.samples)
            return 0 if show(results) else 1


def measure(page: Page, machine: Machine, count: int) -> list[Press]:
    """Opens the page of the arm and measures presses."""
    watch(page)
    page.reload()
    page.get_by_test_id("device-row").filter(has_text="UR5").get_by_role("link").first.click()
    expect(page.get_by_test_id("control-state")).to_be_visible(timeout=PATIENCE_MS)
    drawn: Any = "() => Number(document.querySelector('[data-testid=view-3d]')?.dataset.frames) > 0"
    wait_until(lambda: bool(page.evaluate(drawn)), "the twin", 60)
    return presses(page, machine, count)


if __name__ == "__main__":
    sys.exit(main())
