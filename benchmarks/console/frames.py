"""Ten moving arms on one page: frame intervals and memory.

The cost of opening the page (code, ten scenes, shader compilation) is printed separately. The measured minute starts
``WARM_UP_S`` after every twin is drawn.
"""

import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from playwright.sync_api import Browser, CDPSession, Page, expect

from benchmarks.console.kinematic_arms import start_kinematic_arms
from tests.harness.browser.browser import PATIENCE_MS, pages
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import wait_until

ROBOTS: Final = 10
WARM_UP_S: Final = 20.0
MAX_FRAME_MS: Final = 100.0
MAX_GROWTH_MB_MIN: Final = 0.2
"""Growth after the first minute above which memory counts as leaking [MB/min]."""
MAX_RATIO: Final = 1.1
"""Allowed ratio of nodes and listeners at the end to those after the first minute."""

# Records the time of each frame, and for long frames the browser's attribution.
WATCH_FRAMES: Final = """() => {
    const frames = (window.benchFrames = {gaps: [], long: []});
    let last = performance.now();
    const record = (now) => {
        frames.gaps.push(now - last);
        last = now;
        requestAnimationFrame(record);
    };
    requestAnimationFrame(record);
    new PerformanceObserver((list) => {
        for (const each of list.getEntries()) {
            const until = each.startTime + each.duration;
            frames.long.push({
                duration: each.duration,
                drawing: each.renderStart === 0 ? 0 : until - each.renderStart,
                layout: each.styleAndLayoutStart === 0 ? 0 : until - each.styleAndLayoutStart,
                scripts: each.scripts.map((script) => `${script.invoker} ${Math.round(script.duration)}`),
            });
        }
    }).observe({type: "long-animation-frame"});
}"""
TAKE_FRAMES: Final = """() => {
    const {gaps, long} = benchFrames;
    const frames = {gaps: [...gaps], long: [...long]};
    gaps.length = long.length = 0;
    return frames;
}"""
DRAWN: Final = (
    "() => [...document.querySelectorAll('[data-testid=view-3d]')].map((each) => Number(each.dataset.frames))"
)


@dataclass(frozen=True)
class MemorySample:
    """Memory of a page after garbage collection."""

    heap_mb: float
    nodes: int
    listeners: int

    def __str__(self) -> str:
        return f"{self.heap_mb:.2f} MB, {self.nodes} nodes, {self.listeners} listeners"


def memory_samples(session: CDPSession) -> MemorySample:
    """Collects garbage and takes one sample."""
    session.send("HeapProfiler.collectGarbage")
    heap = session.send("Runtime.getHeapUsage")["usedSize"]
    counted = session.send("Memory.getDOMCounters")
    return MemorySample(heap / 1e6, counted["nodes"], counted["jsEventListeners"])


def steady(every_minute: Sequence[MemorySample]) -> bool:
    """Prints the memory trend since the first minute and returns True if it is level."""
    first, last = every_minute[0], every_minute[-1]
    slope = 0.0
    if len(every_minute) > 1:
        slope = statistics.linear_regression(range(len(every_minute)), [each.heap_mb for each in every_minute]).slope
    level = (
        slope <= MAX_GROWTH_MB_MIN
        and last.nodes <= MAX_RATIO * first.nodes
        and last.listeners <= MAX_RATIO * first.listeners
    )
    print(f"memory {'steady' if level else 'GROWS'}: {slope:+.3f} MB per minute over {len(every_minute) - 1} minutes")
    return level


def open_together(page: Page, machine: Machine, ids: Sequence[str]) -> None:
    """Opens one page with all devices and waits until each receives telemetry and is drawn."""
    page.goto(f"{machine.url}/#/operate/{','.join(ids)}")
    expect(page.get_by_test_id("robot-panel")).to_have_count(len(ids), timeout=PATIENCE_MS)
    wait_until(lambda: [frames > 0 for frames in page.evaluate(DRAWN)] == [True] * len(ids), "every twin")


def measure_fleet(browser: Browser, machine: Machine, minutes: float) -> bool:
    """Measures ten arms and returns True if frame intervals and memory are within the limits."""
    with start_kinematic_arms(machine, ROBOTS) as ids, pages(browser, machine) as (page,):
        session = page.context.new_cdp_session(page)
        page.evaluate(WATCH_FRAMES)
        started_s = time.monotonic()
        open_together(page, machine, ids)
        print(f"{len(ids)} arms, opened in {time.monotonic() - started_s:.1f} s; load {os.getloadavg()[0]:.1f}")
        _show_frames("while opening, not counted", page.evaluate(TAKE_FRAMES))
        time.sleep(WARM_UP_S)
        _show_frames(f"the {WARM_UP_S:.0f} s afterwards, not counted", page.evaluate(TAKE_FRAMES))
        print(f"at the start of the minute: {memory_samples(session)}")
        before = sum(page.evaluate(DRAWN))
        page.evaluate(TAKE_FRAMES)  # the forced collection takes time that does not belong to the page
        time.sleep(60)
        frames = page.evaluate(TAKE_FRAMES)
        drawn = sum(page.evaluate(DRAWN)) - before
        is_smooth = _show_minute(frames, drawn / 60)
        every_minute = [memory_samples(session)]
        print(f"after minute 1: {every_minute[0]}", flush=True)
        for minute in range(2, round(minutes) + 1):
            time.sleep(60)
            every_minute.append(memory_samples(session))
            print(f"after minute {minute}: {every_minute[-1]}", flush=True)
        return steady(every_minute) and is_smooth


def _show_minute(frames: dict[str, Any], drawn_hz: float) -> bool:
    longest = _show_frames("the minute", frames)
    print(f"twins drawn: {drawn_hz:.0f} per second in total; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    for each in sorted(frames["long"], key=lambda frame: -float(frame["duration"]))[:3]:
        print("  {duration:.0f} ms, of which drawing {drawing:.0f}, layout {layout:.0f}; {scripts}".format(**each))
    is_smooth = longest <= MAX_FRAME_MS
    print(f"longest frame {longest:.0f} ms, {'within' if is_smooth else 'MORE THAN'} {MAX_FRAME_MS:.0f} ms", flush=True)
    return is_smooth


def _show_frames(when: str, frames: dict[str, Any]) -> float:
    gaps: list[float] = sorted(frames["gaps"]) or [float("inf")]
    percentiles = [gaps[round((len(gaps) - 1) * share)] for share in (0.5, 0.95, 0.99, 1.0)]
    late = sum(gap > MAX_FRAME_MS for gap in gaps)
    intervals = "p50 {:.0f}, p95 {:.0f}, p99 {:.0f}, max {:.0f}".format(*percentiles)
    print(f"{when}: {len(gaps)} frames, ms apart: {intervals}; over {MAX_FRAME_MS:.0f}: {late}", flush=True)
    return percentiles[-1]
