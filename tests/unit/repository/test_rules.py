"""The repository follows its rules, and each rule finds a planted violation."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.harness.paths import ROOT
from tests.unit.repository import rules


@pytest.mark.parametrize(
    "rule", [rules.wide_folders, rules.long_files, rules.unclear_names, rules.dialect, rules.replaced_rows]
)
def test_the_repository_follows_the_rule(rule: Callable[[Path, list[str]], list[str]]) -> None:
    assert rule(ROOT, rules.tracked_files(ROOT)) == []


def test_every_exception_still_exists() -> None:
    assert set(rules.LONG_FILES) <= set(rules.tracked_files(ROOT))


def test_an_extra_file_in_a_full_folder_is_found(tmp_path: Path) -> None:
    full = [f"package/module_{number}.py" for number in range(rules.MAX_ENTRIES)]
    assert rules.wide_folders(tmp_path, [*full, "package/__init__.py"]) == []
    violation = f"package has {rules.MAX_ENTRIES + 1} entries"
    assert rules.wide_folders(tmp_path, [*full, "package/folder/module.py"]) == [violation]


@pytest.mark.parametrize("name", ["module.py", "page.tsx", "style.css"])
def test_a_file_that_is_one_line_too_long_is_found(tmp_path: Path, name: str) -> None:
    for extra, violations in ((0, []), (1, [f"{name} has {rules.MAX_LINES + 1} lines"])):
        (tmp_path / name).write_text("x = 1\n" * (rules.MAX_LINES + extra), encoding="utf-8")
        assert rules.long_files(tmp_path, [name]) == violations


@pytest.mark.parametrize("stem", sorted(rules.FORBIDDEN_STEMS))
def test_a_file_with_an_unclear_name_is_found(tmp_path: Path, stem: str) -> None:
    names = [f"package/{stem}.py", f"package/test_{stem}.py", f"page/{stem}.css"]
    assert rules.unclear_names(tmp_path, [*names, "package/lease_gate.py"]) == names


@pytest.mark.parametrize("words", [("some", "body"), ("what", " comes"), ("Are", " told"), ("who", "ever")])
@pytest.mark.parametrize("name", ["module.py", "texts.ts", "page.md"])
def test_a_forbidden_word_is_found(tmp_path: Path, words: tuple[str, str], name: str) -> None:
    (tmp_path / name).write_text(f"# The agent\n# {''.join(words)} x\n", encoding="utf-8")
    assert rules.dialect(tmp_path, [name]) == [f"{name}:2: # {''.join(words)} x"]


def test_a_row_that_replaces_another_without_its_unknown_fields_is_found(tmp_path: Path) -> None:
    name = "function_app/services/pairing.py"
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).write_text("row.changed(data)\nRow('p', 'k', data)\nRow('p', 'k', data, row.etag)\n", "utf-8")
    assert rules.replaced_rows(tmp_path, [name]) == [f"{name}:3"]
