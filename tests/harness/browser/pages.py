"""Checks for every page of the console: accessibility, layout and a picture."""

import os
from pathlib import Path
from typing import Final

from playwright.sync_api import Page, ViewportSize

from tests.harness.paths import ROOT

_AXE: Final = ROOT / "web" / "node_modules" / "axe-core" / "axe.min.js"
_PICTURES: Final = ROOT / "docs" / "pictures"
_SIZES: Final[tuple[ViewportSize, ...]] = ({"width": 390, "height": 844}, {"width": 1440, "height": 900})
_GRAVE: Final = """async (part) => {
    const found = await axe.run(part, {resultTypes: ["violations"]});
    return found.violations
        .filter((each) => ["serious", "critical"].includes(each.impact))
        .flatMap((each) => each.nodes.map((node) => `${each.id}: ${node.target.join(" ")}: ${node.failureSummary}`));
}"""
_CLIPPED: Final = """() => {
    const name = (each) => `${each.tagName.toLowerCase()}#${each.id}.${each.className}`;
    const shown = [...document.body.querySelectorAll("*")].filter((each) => each.checkVisibility());
    const tall = shown.filter((each) => each.matches("input, select, button") && each.offsetHeight > 200);
    const tables = shown.filter((each) => each.matches("table")).map((each) => each.parentElement);
    const cut = tables.filter((each) => each.scrollWidth > each.clientWidth + 1);
    return [...tall.map((each) => `${name(each)} is ${each.offsetHeight} px tall`),
            ...cut.map((each) => `table in ${name(each)}: ${each.scrollWidth} px in ${each.clientWidth} px`)];
}"""
_DRAWN_WITHIN_MS: Final = 1_000
_LOOKS: Final = 20
_BETWEEN_LOOKS_MS: Final = 100
_OUTSIDE: Final = """() => {
    const width = document.documentElement.clientWidth;
    if (document.documentElement.scrollWidth <= width) return [];
    return [...document.body.querySelectorAll("*")]
        .filter((each) => each.getBoundingClientRect().right > width + 0.5)
        .map((each) => `${each.tagName.toLowerCase()}.${each.className} to ${each.getBoundingClientRect().right}`);
}"""


def assert_good_page(page: Page, name: str, *, part: str | None = None) -> None:
    """Assert that axe finds no serious violation in either theme and that the page fits a phone.

    If ``TELESCOPE_PICTURES`` is set, saves pictures for the documentation.

    Args:
        page: The page to check.
        name: File name of the pictures.
        part: Test id of the part to check; default: the whole page.
    """
    chosen = "html" if part is None else f"[data-testid={part}]"
    if page.evaluate("() => typeof axe") == "undefined":
        page.evaluate(_AXE.read_text())  # bypasses the page's policy, as a debugger does
    found = []
    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
        found += [f"{scheme}: {each}" for each in page.evaluate(_GRAVE, chosen)]
    assert found == [], f"{name}: " + "\n".join(found)
    for size in _SIZES:
        page.set_viewport_size(size)
        for _ in range(_LOOKS):
            outside = page.evaluate(_OUTSIDE)
            if not outside:
                break
            page.wait_for_timeout(_BETWEEN_LOOKS_MS)  # canvases are redrawn shortly after a resize
        assert outside == [], f"{name} is wider than {size['width']} pixels: " + "; ".join(outside)
        clipped = page.evaluate(_CLIPPED)
        assert clipped == [], f"{name} at {size['width']} pixels: " + "; ".join(clipped)
        if os.environ.get("TELESCOPE_PICTURES"):
            _picture(page, _PICTURES / f"console-{name}-{size['width']}.png", chosen)


def _picture(page: Page, path: Path, chosen: str) -> None:
    page.locator(chosen).evaluate("e => e.scrollIntoView({block: 'start'})")
    page.evaluate("() => document.activeElement.matches(':read-only') || document.activeElement.blur()")
    if page.locator("canvas").count():
        page.wait_for_timeout(_DRAWN_WITHIN_MS)  # a resized canvas is empty until it is redrawn
    page.screenshot(path=path)
