"""Regular expressions for lines of untrusted devices, whose matching time is bounded.

Python tries all ways to divide a text among repetitions, which may take exponential time. Here each repetition is
possessive and each group is atomic: what they have matched is final. So ``.*`` takes the rest of the line; write
``[^=]*=`` for "up to the equals sign". The time is at most proportional to the square of the length of the line.
"""

import re

_TOKEN = re.compile(
    r"(?P<literal>\\[^\d]|\[\^?\]?(?:\\.|[^\]\\])*\]|[^\\\[\](){}*+?])"
    r"|(?P<open>\((?:\?P<[A-Za-z_]\w*>|\?:|(?!\?)))"
    r"|(?P<close>\))"
    r"|(?P<repeat>(?:[*+?]|\{\d{1,3}(?:,\d{0,3})?\})(?![*+?]))"
)


def compiled(pattern: str) -> re.Pattern[str]:
    """The expression, to be used with ``search``.

    Raises:
        ValueError: It is wrong, or contains something other than characters, classes, alternatives, repetitions,
            ``(?P<name>…)`` and ``(?:…)``.
    """
    parts, position = [], 0
    while position < len(pattern):
        token = _TOKEN.match(pattern, position)
        if token is None:
            raise ValueError(
                f"`pattern` cannot be used from '{pattern[position : position + 10]}': it may contain characters, "
                "classes, alternatives, repetitions, (?P<name>…) and (?:…)"
            )
        parts.append(_bounded(token))
        position = token.end()
    try:
        return re.compile("".join(parts), re.ASCII)
    except (re.error, OverflowError, RecursionError) as error:
        raise ValueError(f"`pattern` is not a regular expression: {error}") from error


def _bounded(token: re.Match[str]) -> str:
    """A part of the expression without backtracking."""
    text = token[0]
    match token.lastgroup:
        case "open":
            return f"(?>{'(?:' if text == '(' else text}"
        case "close":
            return "))"
        case "repeat":
            return f"{text}+"
    return text
