"""Documents: links resolve, code blocks are executed, and the tables agree with the code."""

import re
import tomllib
from pathlib import Path

import msgspec
import pytest

from device_agent import bootstrap as agent_bootstrap
from device_agent.config.agent_config import CONFIG_FILE, AgentConfig
from device_agent.protocol.events import EventKind
from function_app import bootstrap, settings
from function_app.domain.control.control_events import Fact
from function_app.entrypoints.http.app import create_app
from tests.harness.documents import block, blocks
from tests.harness.paths import ROOT

DOCS = ROOT / "docs"
SECURITY = (ROOT / "SECURITY.md").read_text()
ROOT_PAGES = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md")
PAGES = sorted(
    page for page in [*(ROOT / name for name in ROOT_PAGES), *DOCS.rglob("*.md")] if "node_modules" not in page.parts
)
GENERATED = {DOCS / "reference" / "messages.md", DOCS / "reference" / "openapi.md"}
"""Pages that ``make docs`` creates."""
EXECUTED = {
    "README.md": "tests/e2e/product/test_readme.py",
    "docs/guides/use-the-api.md": "tests/e2e/product/test_readme.py",
    "docs/guides/add-a-robot.md": "tests/integration/docs/test_guides.py",
    "docs/guides/install-an-agent.md": "tests/integration/docs/test_guides.py",
    "docs/guides/operate-a-site.md": "tests/integration/docs/test_guides.py",
    "docs/guides/security-on-a-site.md": "tests/integration/docs/test_guides.py",
    "docs/guides/add-a-sensor.md": "tests/unit/device_agent/sensors/test_add_a_sensor.py",
    "docs/guides/room-devices.md": "tests/unit/device_agent/sensors/test_configured_devices.py",
    "docs/robots/nao.md": "tests/e2e/product/test_robot_pages.py",
    "docs/robots/ros.md": "tests/e2e/product/test_ros.py",
    "docs/robots/universal-robots.md": "tests/e2e/product/test_robot_pages.py",
    "docs/reference/scripts.md": "tests/e2e/product/test_readme.py",
    "docs/reference/room-and-perception.md": "tests/unit/docs/test_pages.py",
    "docs/reference/configuration.md": "tests/unit/docs/test_pages.py",
}
"""Pages with executed blocks, and the test that executes them."""
_LINK = re.compile(r"(?<!\!)\[[^\]]*\]\(([^)\s]+)\)|!\[[^\]]*\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def text_of(page: Path) -> str:
    return _FENCE.sub("", page.read_text(encoding="utf-8"))


def links(page: Path) -> list[str]:
    found = (first or second for first, second in _LINK.findall(text_of(page)))
    return [each for each in found if not each.startswith(("http://", "https://"))]


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", each.lower().replace("`", "")).strip()) for each in headings}


def test_links_resolve() -> None:
    broken = []
    for page in PAGES:
        for link in links(page):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            if target in GENERATED:
                continue
            if not target.exists() or (anchor and anchor not in anchors(target)):
                broken.append(f"{page.relative_to(ROOT)}: {link}")
    assert broken == []


def test_each_code_block_is_executed_or_states_why_not() -> None:
    unmarked = []
    for page in PAGES:
        name = str(page.relative_to(ROOT))
        if name in ROOT_PAGES[1:] or page.parent.name in {"results", "decisions"}:
            continue
        for each in blocks(page):
            if each.language in {"", "mermaid"} or each.text == "make up\n":
                continue
            if not each.use:
                unmarked.append(f"{name}: {each.text[:60]}")
            elif each.use != "example":
                test = (ROOT / EXECUTED[name]).read_text(encoding="utf-8")
                assert page.stem in test or page.name in test, f"{EXECUTED[name]} does not execute {name}"
    assert unmarked == []


def test_the_agent_accepts_the_configuration_examples() -> None:
    agent = block(DOCS / "reference" / "configuration.md", "file", "agent.toml")
    interlock = block(DOCS / "reference" / "room-and-perception.md", "file", "interlock.toml")
    both = agent.replace("[[room]]", interlock + "\n[[room]]")
    configuration = msgspec.convert(tomllib.loads(both), AgentConfig)
    assert configuration.devices[-1].interlocks[0].stale_s == 2.0


def test_every_setting_of_the_product_is_documented() -> None:
    sources = [*(ROOT / "function_app").rglob("*.py"), *(ROOT / "infra" / "local").rglob("*.py")]
    used = {name for path in sources for name in re.findall(r'"(TELESCOPE_[A-Z0-9_]*[A-Z0-9])"', path.read_text())}
    page = (DOCS / "reference" / "configuration.md").read_text()
    documented = set(re.findall(r"TELESCOPE_[A-Z0-9_]*[A-Z0-9]", page))
    internal = {"TELESCOPE_TRACE", "TELESCOPE_SIGN_IN", "TELESCOPE_KEY", "TELESCOPE_TOKEN"}
    assert used - documented - internal == set()


def test_every_event_is_documented() -> None:
    page = (DOCS / "reference" / "errors-and-events.md").read_text()
    assert {each.value for each in (*EventKind, *Fact)} - set(re.findall(r"`([a-z-]+)`", page)) == set()


def test_every_documented_endpoint_exists(tmp_path: Path) -> None:
    app = create_app(bootstrap.build(settings.read({"TELESCOPE_HOME": str(tmp_path)})))
    paths = {path.removeprefix("/api/v1") for path in app.openapi()["paths"]}
    page = (DOCS / "reference" / "http-api.md").read_text()
    named = set(re.findall(r"`(?:GET|POST|PUT|DELETE) (/[^`?]+)`", page))
    assert len(named) > 50
    assert named - paths == set()


def test_the_first_pages_are_short() -> None:
    assert (DOCS / "architecture.md").stat().st_size <= 10_000
    assert len((ROOT / "README.md").read_text().splitlines()) <= 90


def test_each_file_of_the_change_requests_exists() -> None:
    paths = re.findall(r"^\| \d+ \| .+? \| `([^`]+)` \|$", (DOCS / "change-requests.md").read_text(), re.MULTILINE)
    assert len(paths) == 30
    assert [path for path in paths if not (ROOT / path).is_file()] == []


@pytest.mark.parametrize(
    "row", [row for row in SECURITY.splitlines() if re.match(r"\| (?!---|asset|attacker|risk)", row)]
)
def test_each_row_of_the_security_page_names_existing_tests(row: str) -> None:
    tests = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", row)
    assert tests
    assert [test for path, test in tests if f"def {test}(" not in (ROOT / path).read_text()] == []


def test_the_security_page_states_what_each_attacker_can_still_do() -> None:
    section = SECURITY.partition("## What each attacker can still do")[2].partition("\n## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:3]] for line in section.splitlines() if line.startswith("| ")][
        2:
    ]
    attackers = [attacker for attacker, _ in rows if attacker]
    assert [target for _, target in rows] == ["motion", "data", "availability"] * len(attackers)
    named = {"broker", "function", "store", "agent in the same space", "script", "local user", "network"}
    assert {name for name in named if not any(name in attacker for attacker in attackers)} == set()


def test_the_security_page_has_a_row_for_each_api_risk() -> None:
    assert len(re.findall(r"^\| API", SECURITY, re.MULTILINE)) == 10


def test_ten_questions_are_answered_within_two_clicks_of_the_start_page() -> None:
    start = DOCS / "index.md"
    questions = re.findall(r"^\d+\. \[[^\]]+\?\]\(([^)#]+)", start.read_text(), re.MULTILINE)
    assert len(questions) == 10
    first = {(start.parent / link.partition("#")[0]).resolve() for link in links(start) if ".md" in link}
    second = {
        (page.parent / link.partition("#")[0]).resolve()
        for page in first - GENERATED
        for link in links(page)
        if ".md" in link
    }
    assert {(start.parent / link).resolve() for link in questions} <= first
    pages = {page for page in PAGES if page.is_relative_to(DOCS)}
    assert pages - first - second - {start} == set()


def test_the_navigation_of_the_site_lists_every_page() -> None:
    listed = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    pages = {str(page.relative_to(DOCS)) for page in PAGES if page.is_relative_to(DOCS)}
    decisions = {page for page in pages if page.startswith("decisions/")}  # added by a hook
    assert pages - decisions == listed - {"reference/messages.md", "reference/openapi.md"}


def test_the_agent_accepts_the_entries_of_the_camera_guide(tmp_path: Path) -> None:
    text = "\n".join(each.text for each in blocks(DOCS / "guides" / "room-cameras.md") if each.language == "toml")
    (tmp_path / CONFIG_FILE).write_text(text)
    entries = AgentConfig.load(tmp_path).devices
    devices = [agent_bootstrap.create_room_device(entry, {}, home=tmp_path) for entry in entries]
    assert [device and device.manifest.driver for device in devices] == ["rtsp", "v4l2"]
