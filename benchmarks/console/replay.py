"""Times of the page of a recorded session in Chromium: seeking and scrubbing in a session of one hour.

``python -m benchmarks.console.replay [--minutes 60] [--pictures FOLDER]`` opens the page of the product with a recorded
session of ``tests/harness/browser/recorded_session.py``. A seek is a press on the timeline at a random time. It ends
when the page shows the row of that time from the file of its minute. Until then the page shows the overview. The time
contains the download of the file from this program, which is measured alone too. Scrubbing
moves the pressed pointer once in each frame and counts the frames in which cursor and values changed.
"""

import argparse
import contextlib
import os
import platform
import random
import statistics
import sys
import tempfile
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

from playwright.sync_api import BrowserContext, Page, Route, expect, sync_playwright

from tests.harness.browser.browser import FLAT, PATIENCE_MS, chromium, pages
from tests.harness.browser.product import start_machine
from tests.harness.browser.recorded_session import EPOCH, FILES, RecordedSession, record_session

MAX_SEEK_MS: Final = 200.0
MIN_FRAMES_S: Final = 30.0
SCRUB_S: Final = 10.0
_SEEKS: Final = 30
DOWNLOAD: Final = """async () => {
    const times = [];
    for (let file = 0; file < 10; file += 1) {
        const start = performance.now();
        await (await fetch(`FILES/EPOCH-${file % 3}.mcap`)).arrayBuffer();
        times.push(performance.now() - start);
    }
    return times;
}"""

WATCH: Final = """() => {
    const marks = (window.benchMarks = {});
    const find = (selector) => document.querySelector(selector)?.dataset ?? {};
    const kind = () => find("[data-testid=session-row] .session-facts").kind;
    const frames = () => Number(find("[data-testid=session-view]").frames);
    addEventListener("pointerdown", (event) => {
        const pressed = event.timeStamp;
        const drawn = frames();
        for (const name of Object.keys(marks)) delete marks[name];
        const look = () => {
            const now = performance.now() - pressed;
            marks.shown ??= now;
            if (frames() > drawn) marks.twin ??= now;
            if (kind() === "row") marks.row ??= now;
            if (marks.row === undefined) requestAnimationFrame(look);
        };
        requestAnimationFrame(look);
    }, {capture: true});
}"""
SCRUB: Final = """async ([seconds]) => {
    const bar = document.querySelector("[data-testid=session-bar]");
    const clock = () => document.querySelector("[data-testid=session-clock]").dataset.at;
    const twin = () => Number(document.querySelector("[data-testid=session-view]").dataset.frames);
    const {left, width, top} = bar.getBoundingClientRect();
    const [start, drawn] = [performance.now(), twin()];
    const gaps = [];
    let [changed, last, previous] = [0, clock(), start];
    while (performance.now() - start < seconds * 1000) {
        const share = 0.5 - 0.45 * Math.cos((performance.now() - start) / 1500);
        const place = {clientX: left + share * width, clientY: top + 5};
        bar.dispatchEvent(new PointerEvent("pointermove", {pointerId: 1, bubbles: true, ...place}));
        await new Promise(requestAnimationFrame);
        const now = performance.now();
        gaps.push(now - previous);
        previous = now;
        if (clock() !== last) changed += 1;
        last = clock();
    }
    const took_s = (performance.now() - start) / 1000;
    return {frames_s: changed / took_s, twin_s: (twin() - drawn) / took_s, gaps};
}"""


@contextlib.contextmanager
def file_server(context: BrowserContext, session: RecordedSession) -> Iterator[None]:
    """Serves the files over HTTP, because files that Playwright passes to the browser take longer."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            content = session.files[self.path.rpartition("/")[2]]
            first, _, last = self.headers.get("Range", "").removeprefix("bytes=").partition("-")
            self.send_response(206 if first else 200)
            if first:
                content = content[int(first) : int(last) + 1]
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            with contextlib.suppress(ConnectionError):  # the page no longer needs the file
                self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Prints nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()

        def forward(route: Route) -> None:
            name = route.request.url.rpartition("/")[2]
            route.continue_(url=f"http://127.0.0.1:{server.server_port}/{name}")

        context.route(f"**{FILES}/*", forward)
        yield
        server.shutdown()
        thread.join()


def open_session(page: Page, device: str) -> None:
    """Opens the page of the session and waits until everything is loaded."""
    page.evaluate(f"() => {{ location.hash = '#/devices/{device}/sessions/{EPOCH}'; }}")
    expect(page.get_by_test_id("session-bar")).to_be_visible(timeout=PATIENCE_MS)
    expect(page.locator("[data-testid=session-row] [data-kind=row]")).to_be_visible(timeout=PATIENCE_MS)
    page.get_by_test_id("session-bar").scroll_into_view_if_needed()
    page.wait_for_timeout(3_000)


def measure_seeks(page: Page) -> dict[str, list[float]]:
    """Presses random places of the timeline. Returns the times from the press, by part [ms]."""
    box = page.get_by_test_id("session-bar").bounding_box()
    assert box is not None
    chance = random.Random(1)
    results: dict[str, list[float]] = {"shown": [], "twin": [], "row": []}
    while len(results["row"]) < _SEEKS:
        page.mouse.click(box["x"] + box["width"] * chance.uniform(0.01, 0.99), box["y"] + 10)
        page.wait_for_timeout(1_500)
        marks: dict[str, float] = page.evaluate("() => benchMarks")
        if "row" in marks:  # the time is not in a gap
            for part, times in results.items():
                if part in marks:
                    times.append(marks[part])
    return results


def measure_scrubbing(page: Page) -> dict[str, Any]:
    """Moves the pressed pointer along the timeline in each frame."""
    box = page.get_by_test_id("session-bar").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 5, box["y"] + 10)
    page.mouse.down()
    result: dict[str, Any] = page.evaluate(SCRUB, [SCRUB_S])
    page.mouse.up()
    return result


def p95_of(times: list[float]) -> float:
    """The 95th percentile."""
    return sorted(times)[round((len(times) - 1) * 0.95)]


def show(seeks: dict[str, list[float]], scrubbing: dict[str, Any], minutes: int) -> bool:
    """Prints the results and returns True if both are within their limits."""
    print(f"{platform.python_version()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {minutes} minutes")
    for part, times in seeks.items():
        if times:
            p50, p95, longest = statistics.median(times), p95_of(times), max(times)
            print(f"seek: {part:8} p50 {p50:6.0f} ms, p95 {p95:6.0f} ms, max {longest:6.0f} ms")
    print(
        f"scrubbing: {scrubbing['frames_s']:.1f} frames/s, twin {scrubbing['twin_s']:.1f} frames/s, "
        f"time between frames p95 {p95_of(scrubbing['gaps']):.0f} ms"
    )
    return p95_of(seeks["row"]) <= MAX_SEEK_MS and scrubbing["frames_s"] >= MIN_FRAMES_S


def take_pictures(page: Page, folder: Path) -> None:
    """Pictures of the page on a desktop and on a phone."""
    folder.mkdir(parents=True, exist_ok=True)
    for width, height in ((1440, 900), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(1_500)
        page.screenshot(path=folder / f"session-{width}.png", full_page=True)


def main() -> int:
    """Runs the command line."""
    parser = argparse.ArgumentParser(description="Measure the page of a recorded session.")
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument(
        "--flat", action="store_true", help="without 3D rendering, which is slow without a graphics card"
    )
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the page")
    chosen = parser.parse_args()
    session = record_session(chosen.minutes)
    with (
        tempfile.TemporaryDirectory(prefix="ts-bench-replay-") as name,
        start_machine(Path(name)) as machine,
        sync_playwright() as playwright,
        chromium(playwright, *([FLAT] if chosen.flat else [])) as browser,
        machine.api() as api,
        pages(browser, machine) as (page,),
    ):
        device = api.device()["id"]
        session.serve(page.context, device)
        page.evaluate(f"({WATCH})()")
        with file_server(page.context, session):
            open_session(page, device)
            seeks = measure_seeks(page)
            seeks["download"] = page.evaluate(DOWNLOAD.replace("FILES", FILES).replace("EPOCH", str(EPOCH)))
            scrubbing = measure_scrubbing(page)
            reached = show(seeks, scrubbing, chosen.minutes)
            if chosen.pictures is not None:
                take_pictures(page, chosen.pictures)
    return 0 if reached else 1


if __name__ == "__main__":
    sys.exit(main())
