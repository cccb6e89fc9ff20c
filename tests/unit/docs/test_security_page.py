"""``SECURITY.md`` names tests: each of them is there."""

import re

from tests.harness.paths import ROOT

NAMED = re.compile(r"`(tests/[\w/]+\.py)::(test_\w+)`")


def test_every_test_that_the_page_names_is_there() -> None:
    text = (ROOT / "SECURITY.md").read_text()
    named = NAMED.findall(text)
    assert len(named) > 30
    for path, name in named:
        assert re.search(rf"def {name}\(", (ROOT / path).read_text()), f"{path} has no {name}"


def test_every_line_of_both_tables_names_one() -> None:
    rows = [line for line in (ROOT / "SECURITY.md").read_text().splitlines() if line.startswith("|")]
    rows = [row for row in rows if not row.startswith(("| ---", "| asset", "| risk"))]
    assert len([row for row in rows if row.startswith("| API")]) == 10
    for row in rows:
        assert NAMED.search(row), row
