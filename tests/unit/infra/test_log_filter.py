"""Log lines that clients cause are limited."""

import logging

from infra.embedded_broker.log_filter import REPEAT_S, RepeatFilter


class Log:
    """The lines that pass the filter, at a time that the test sets."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._filter = RepeatFilter(lambda: self.now_s)

    def line(self, text: str) -> str | None:
        record = logging.LogRecord("x", logging.WARNING, "", 0, "%s", (text,), None)
        return record.getMessage() if self._filter.filter(record) else None


def test_a_repeated_line_appears_once_a_minute_with_the_number_of_omitted_ones() -> None:
    log = Log()
    assert log.line("agent: published to 'x'") == "agent: published to 'x'"
    assert [log.line("agent: published to 'x'") for _ in range(9)] == [None] * 9
    assert log.line("other: published to 'x'") == "other: published to 'x'"
    log.now_s = REPEAT_S
    assert log.line("agent: published to 'x'") == "agent: published to 'x' (omitted 9 times before)"


def test_different_lines_are_limited_per_second() -> None:
    log = Log()
    assert sum(log.line(str(number)) is not None for number in range(10_000)) == 400
    log.now_s = 1.0
    assert sum(log.line(f"next {number}") is not None for number in range(10_000)) == 20
