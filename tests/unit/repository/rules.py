"""Rules for the structure and the language of the repository. Each function returns the violations it finds."""

import ast
import re
import subprocess
from collections import Counter
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Final

MAX_ENTRIES: Final = 16
MAX_LINES: Final = 400
ROW_FIELDS: Final = 3
"""Partition, key and data of a new row."""
SOURCES: Final = frozenset({".py", ".ts", ".tsx", ".css", ".mjs", ".cjs", ".lua"})
TEXTS: Final = SOURCES | {".md", ".toml", ".html", ".yml", ".service"}
WIDE_FOLDERS: Final = {
    ".": "files that a Functions host, package tools and repository hosts expect in the root",
    "device_agent": "one package for each layer and capability of the agent",
    "docs/decisions": "numbered decision records, one file each",
    "docs/pictures": "screenshots that the browser tests write",
}
"""Folders that may have more entries, each with the reason."""
LONG_FILES: Final = {
    "web/src/shared/mqtt/protocol.generated.ts": "generated from docs/asyncapi.json",
    "examples/legacy/telescope_legacy.py": "one file is the product: it is copied to robots",
}
"""Files that may be longer, each with the reason."""
FORBIDDEN_STEMS: Final = frozenset(
    word
    for line in (
        "office helm pilot voice vigil shelf errand pace way ride score slack shows rounds tend tell look_at",
        "asking kept held gather later lasting turns desk care courses sight seals fence forget ailments",
        "knife rig toys wire",
    )
    for word in line.split()
)
_WORDS: Final = [
    word.replace("-", "").replace("_", " ")
    for word in ["who-ever", "some-body", "no-body", "what-ever", "what_-comes", "is_-told", "are_-told"]
]
FORBIDDEN_WORDS: Final = re.compile(rf"\b(?:{'|'.join(_WORDS)})\b", re.IGNORECASE)
"""Dialect of earlier versions. The words are split so that this file does not contain them."""


def tracked_files(root: Path) -> list[str]:
    """Returns the paths of the files under version control, relative to ``root``."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.split("\0") if name and (root / name).is_file()]


def wide_folders(_: Path, files: Iterable[str]) -> list[str]:
    """Returns each folder with more than ``MAX_ENTRIES`` files and sub-folders; ``__init__.py`` does not count."""
    entries: set[PurePosixPath] = set()
    for path in map(PurePosixPath, files):
        if path.name != "__init__.py":
            entries |= {path, *path.parents}
    counts = Counter(str(entry.parent) for entry in entries if entry != PurePosixPath("."))
    wide = {folder: count for folder, count in counts.items() if count > MAX_ENTRIES and folder not in WIDE_FOLDERS}
    return [f"{folder} has {count} entries" for folder, count in sorted(wide.items())]


def long_files(root: Path, files: Iterable[str]) -> list[str]:
    """Returns each source file with more than ``MAX_LINES`` lines."""
    sources = [name for name in files if PurePosixPath(name).suffix in SOURCES and name not in LONG_FILES]
    lines = {name: len((root / name).read_text(encoding="utf-8").splitlines()) for name in sources}
    return [f"{name} has {count} lines" for name, count in lines.items() if count > MAX_LINES]


def unclear_names(_: Path, files: Iterable[str]) -> list[str]:
    """Returns each source file whose name contains a term that is not standard."""
    return [
        name
        for name in files
        if PurePosixPath(name).suffix in SOURCES and _parts(PurePosixPath(name).stem) & FORBIDDEN_STEMS
    ]


def dialect(root: Path, files: Iterable[str]) -> list[str]:
    """Returns each line of code or text with a forbidden word."""
    return [
        f"{name}:{number}: {line.strip()}"
        for name in files
        if PurePosixPath(name).suffix in TEXTS
        for number, line in enumerate((root / name).read_text(encoding="utf-8").splitlines(), 1)
        if FORBIDDEN_WORDS.search(line)
    ]


def replaced_rows(root: Path, files: Iterable[str]) -> list[str]:
    """Returns each construction of a row with an ETag: ``Row.changed`` also keeps unknown fields."""
    return [
        f"{name}:{node.lineno}"
        for name in files
        if name.startswith(("function_app/services/", "function_app/adapters/shared/grant"))
        for node in ast.walk(ast.parse((root / name).read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Row" and len(node.args) > ROW_FIELDS
    ]


def _parts(stem: str) -> set[str]:
    stem = stem.removeprefix("test_")
    return {stem, *re.split(r"[_.-]", stem)}
