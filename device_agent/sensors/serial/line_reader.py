"""Divides received bytes into lines of bounded length, and lines into fields."""

from collections.abc import Callable, Iterator
from typing import Any

from device_agent.sensors import json_path
from device_agent.sensors.serial import line_pattern
from device_agent.sensors.serial.options import Options

Fields = Callable[[str | int], Any]
"""Returns the raw value of a field; raises ``LineError`` if the line has no such field."""
_SHOWN = 60


class LineError(ValueError):
    """A line is not usable. The message completes "the line is …"."""


class LineReader:
    """Collects lines. The first line is dropped, because reading may have started in its middle.

    Args:
        max_line: Longest line [bytes].
    """

    def __init__(self, max_line: int) -> None:
        self._max_line = max_line
        self._partial = bytearray()
        self._skipping = True
        self._too_long = False

    def add(self, data: bytes) -> Iterator[bytes | None]:
        """The lines that end in these bytes, without their ends; ``None`` for one that is too long."""
        *ends, rest = data.replace(b"\r", b"\n").split(b"\n")
        for end in ends:
            self._append(end)
            line, too_long = bytes(self._partial), self._too_long
            self._partial.clear()
            self._too_long = False
            if self._skipping:
                self._skipping = False
            elif too_long:
                yield None
            elif line.strip():
                yield line
        self._append(rest)

    def _append(self, data: bytes) -> None:
        if self._skipping or self._too_long:
            return
        if len(self._partial) + len(data) > self._max_line:
            self._partial.clear()
            self._too_long = True
        else:
            self._partial += data


def parser(options: Options) -> Callable[[bytes], Fields]:
    """The function that divides a line into fields. It raises ``LineError`` for a line that is not usable."""
    return _PARSERS[options.format](options)


def _pattern_parser(options: Options) -> Callable[[bytes], Fields]:
    pattern = line_pattern.compiled(options.pattern)

    def parse(line: bytes) -> Fields:
        found = pattern.search(_text(line))
        if found is None:
            raise LineError(f"{_shown(line)}, which `pattern` does not match")
        return lambda field: _number(found[field], field)

    return parse


def _json_parser(_: Options) -> Callable[[bytes], Fields]:
    def parse(line: bytes) -> Fields:
        try:
            document = json_path.decode(line)
        except ValueError as error:
            raise LineError(f"{_shown(line)}, which is not JSON") from error

        def field_of(field: str | int) -> Any:
            value = json_path.find(document, str(field))
            if value is json_path.MISSING:
                raise LineError(f"missing: the line has no '{field}'; it has: {json_path.listed(document)}")
            return value

        return field_of

    return parse


def _csv_parser(options: Options) -> Callable[[bytes], Fields]:
    def parse(line: bytes) -> Fields:
        columns = _text(line).split(options.separator)

        def column(field: str | int) -> Any:
            if int(field) >= len(columns):
                raise LineError(f"missing: the line has only {len(columns)} columns")
            return _number(columns[int(field)], field)

        return column

    return parse


_PARSERS: dict[str, Callable[[Options], Callable[[bytes], Fields]]] = {
    "pattern": _pattern_parser,
    "json": _json_parser,
    "csv": _csv_parser,
}


def _text(line: bytes) -> str:
    return line.decode("ascii", errors="replace")


def _number(text: str | None, field: str | int) -> float | str:
    """The number in a text; the text itself if it is none, which ``words`` may map."""
    if text is None:
        raise LineError(f"missing: the line has no '{field}'")
    try:
        return float(text)
    except ValueError:
        return text.strip()


def _shown(line: bytes) -> str:
    text = "".join(letter if letter.isprintable() else "?" for letter in _text(line[:_SHOWN]))
    return f"'{text}{'…' if len(line) > _SHOWN else ''}'"
