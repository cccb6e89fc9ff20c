"""Patterns of serial lines: what they match, and that no line can take long."""

import pytest

from device_agent.sensors.serial.line_pattern import compiled
from device_agent.sensors.serial.line_reader import LineReader


@pytest.mark.parametrize(
    ("pattern", "line", "fields"),
    [
        (r"T=(?P<t>[-+]?\d+\.\d+)", "x T=-21.5 C", {"t": "-21.5"}),
        (r"(?P<a>\d{2,3})(?:,(?P<b>\w+))?", "12", {"a": "12", "b": None}),
        (r"(?P<a>cold|hot)\s*;", "hot  ;", {"a": "hot"}),
        (r"[^=]*=(?P<a>[\d.]+)\]", "key=1.5]", {"a": "1.5"}),
        (r"(ab)+(?P<a>[)\]]{2})", "abab)]", {"a": ")]"}),
        (r"^(?P<a>[]x]+)$", "]x]", {"a": "]x]"}),
    ],
)
def test_patterns_match_as_usual(pattern: str, line: str, fields: dict[str, str | None]) -> None:
    found = compiled(pattern).search(line)
    assert found is not None
    assert found.groupdict() == fields


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "pattern", [r"(a+)+$", r"(a|aa)+$", r"(?:a*)*b", r"a*a*a*a*a*a*a*a*a*a*b", r"(?P<x>(?:a|a)*)c", r"(a?){100}a{100}$"]
)
def test_a_hostile_line_takes_no_longer_than_its_square(pattern: str) -> None:
    """Without bounds, each of them takes longer than the age of the universe."""
    assert compiled(pattern).search("a" * 2000 + "!") is None


def test_a_repetition_gives_nothing_back() -> None:
    assert compiled(r".*=(?P<a>\d+)").search("key=1") is None


@pytest.mark.parametrize(
    "pattern",
    [
        r"(?=a)",
        r"(?!a)",
        r"(?<=a)b",
        r"(a)\1",
        r"(?P<a>x)(?P=a)",
        r"(?i)a",
        r"(?i:a)",
        r"a*?",
        r"a++",
        r"(?#x)",
        r"(?>a)",
    ],
)
def test_other_constructs_are_rejected(pattern: str) -> None:
    with pytest.raises(ValueError, match="`pattern` cannot be used from '"):
        compiled(pattern)


@pytest.mark.parametrize("pattern", [r"(a", r"a)", r"*", r"(?P<a>x)(?P<a>y)", r"[z-a]"])
def test_wrong_patterns_are_rejected(pattern: str) -> None:
    with pytest.raises(ValueError, match="`pattern`"):
        compiled(pattern)


def test_lines_are_joined_from_pieces_of_any_size() -> None:
    data = b"rest\nfirst\r\n\r\nsecond\rtoo long line\nthird\nunfinished"
    for size in (1, 3, 1000):
        reader = LineReader(8)
        found = [line for start in range(0, len(data), size) for line in reader.add(data[start : start + size])]
        assert found == [b"first", b"second", None, b"third"]


def test_an_endless_line_needs_no_memory() -> None:
    reader = LineReader(8)
    assert list(reader.add(b"\n")) == []
    for _ in range(100):
        assert list(reader.add(b"x" * 1000)) == []
    assert len(reader._partial) <= 8
