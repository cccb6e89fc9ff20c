"""The repository follows its rules, and each rule fails on a planted violation."""

from pathlib import Path

import pytest

from tests.harness.paths import ROOT
from tests.unit.repository import rules


@pytest.fixture(scope="module")
def files() -> list[str]:
    return rules.tracked_files(ROOT)


def test_folders_have_at_most_sixteen_entries(files: list[str]) -> None:
    assert rules.wide_folders(files) == []


def test_files_have_at_most_four_hundred_lines(files: list[str]) -> None:
    assert rules.long_files(ROOT, files) == []


def test_file_names_are_standard_terms(files: list[str]) -> None:
    assert rules.unclear_names(files) == []


def test_texts_are_free_of_dialect(files: list[str]) -> None:
    assert rules.dialect(ROOT, files) == []


def test_every_exception_still_exists(files: list[str]) -> None:
    assert set(rules.LONG_FILES) <= set(files)


def test_an_extra_file_in_a_full_folder_is_found() -> None:
    full = [f"package/module_{number}.py" for number in range(rules.MAX_ENTRIES)]
    assert rules.wide_folders([*full, "package/__init__.py"]) == []
    assert rules.wide_folders([*full, "package/folder/module.py"]) == [f"package has {rules.MAX_ENTRIES + 1} entries"]


@pytest.mark.parametrize("name", ["module.py", "page.tsx", "style.css"])
def test_a_file_that_is_one_line_too_long_is_found(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("x = 1\n" * rules.MAX_LINES, encoding="utf-8")
    assert rules.long_files(tmp_path, [name]) == []
    (tmp_path / name).write_text("x = 1\n" * (rules.MAX_LINES + 1), encoding="utf-8")
    assert rules.long_files(tmp_path, [name]) == [f"{name} has {rules.MAX_LINES + 1} lines"]


@pytest.mark.parametrize("stem", sorted(rules.FORBIDDEN_STEMS))
def test_a_file_with_an_unclear_name_is_found(stem: str) -> None:
    names = [f"package/{stem}.py", f"package/test_{stem}.py", f"page/{stem}.css"]
    assert rules.unclear_names([*names, "package/lease_gate.py"]) == names


@pytest.mark.parametrize("words", [("some", "body"), ("what", " comes"), ("Are", " told"), ("who", "ever")])
@pytest.mark.parametrize("name", ["module.py", "texts.ts", "page.md"])
def test_a_forbidden_word_is_found(tmp_path: Path, words: tuple[str, str], name: str) -> None:
    (tmp_path / name).write_text(f"# The agent\n# {''.join(words)} x\n", encoding="utf-8")
    assert rules.dialect(tmp_path, [name]) == [f"{name}:2: # {''.join(words)} x"]
