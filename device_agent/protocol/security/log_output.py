"""Log output of all programs: readable text or JSON lines, rotated files, and a limit for lines that repeat."""

import json
import logging
import sys
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

FILE_BYTES = 10_000_000
FILE_COUNT = 5
"""A log file is renamed at this size; this number of older files is kept."""
BURST = 10
"""Lines with the same text in the source code that may follow each other."""
REFILL_S = 10.0
"""After the burst, one such line appears in this time [s]."""
MAX_TRACEBACK = 4_000
"""Last characters of a traceback."""
_TOTAL_BURST = 400
_TOTAL_PER_S = 20
_MAX_KEYS = 1_000
_MAX_RECENT = 20
_MAX_MESSAGE = 2_000

context: ContextVar[Callable[[], Mapping[str, str]] | None] = ContextVar("log context", default=None)
"""Returns ``request``, ``action``, ``device`` and ``trace_id`` of the work; called only if a line is written."""


def add_arguments(parser: "argparse.ArgumentParser", environment: Mapping[str, str]) -> None:
    """Add ``--log-format`` and ``--log-file``; by default the values of the environment."""
    log_format = environment.get("TELESCOPE_LOG_FORMAT", "text")
    parser.add_argument(
        "--log-format",
        choices=("text", "json"),
        default=log_format if log_format in {"text", "json"} else "text",
        help="readable text, or one JSON object in each line (default: TELESCOPE_LOG_FORMAT, or text)",
    )
    parser.add_argument(
        "--log-file",
        type=Path,
        metavar="FILE",
        help=f"write to this file instead of stderr; it is renamed at {FILE_BYTES // 1_000_000} MB, and {FILE_COUNT} "
        "older files are kept",
    )


def configure(options: "argparse.Namespace") -> None:
    """Set up the root logger from the arguments of ``add_arguments``.

    Raises:
        OSError: The file cannot be written.
    """
    logging.basicConfig(level=logging.INFO, handlers=[create_handler(options), recent])


def create_handler(options: "argparse.Namespace") -> logging.Handler:
    """The output of the log. Raises ``OSError``: the file cannot be written."""
    handler: logging.Handler = logging.StreamHandler(sys.stderr)
    if options.log_file is not None:
        from logging.handlers import RotatingFileHandler  # noqa: PLC0415 (slow, and not for cloud functions)

        handler = RotatingFileHandler(options.log_file, maxBytes=FILE_BYTES, backupCount=FILE_COUNT, encoding="utf-8")
    handler.setFormatter(JsonFormatter() if options.log_format == "json" else TextFormatter())
    handler.addFilter(RateLimit())
    return handler


class TextFormatter(logging.Formatter):
    """Readable lines; the context follows in brackets."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 (overridden)
        """See ``logging.Formatter``."""
        fields = " ".join(f"{name}={value}" for name, value in _context().items())
        return super().formatMessage(record) + (f" [{fields}]" if fields else "")

    def formatException(self, ei: object) -> str:  # noqa: N802 (overridden)
        """See ``logging.Formatter``."""
        return super().formatException(ei)[-MAX_TRACEBACK:]  # type: ignore[arg-type]


class JsonFormatter(TextFormatter):
    """One JSON object in each line."""

    def format(self, record: logging.LogRecord) -> str:
        """See ``logging.Formatter``."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_context(),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


class RateLimit(logging.Filter):
    """Passes a burst of lines with the same text in the source code, then one every ten seconds.

    The next line names the number of omitted ones. All lines together have a limit as well, because messages of
    libraries may have many texts.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now_s = now_s
        self._keys: OrderedDict[tuple[str, int, str], tuple[float, float, int]] = OrderedDict()
        self._total, self._refilled_s = float(_TOTAL_BURST), now_s()

    def filter(self, record: logging.LogRecord) -> bool:
        """See ``logging.Filter``."""
        now_s = self._now_s()
        key = (record.name, record.levelno, str(record.msg))
        budget, at_s, omitted = self._keys.pop(key, (float(BURST), now_s, 0))
        budget = min(BURST, budget + (now_s - at_s) / REFILL_S)
        self._total = min(_TOTAL_BURST, self._total + (now_s - self._refilled_s) * _TOTAL_PER_S)
        self._refilled_s = now_s
        passes = budget >= 1 and self._total >= 1
        if passes:
            budget, self._total = budget - 1, self._total - 1
            if omitted:
                record.msg, record.args = "%s (%d similar lines omitted)", (record.getMessage(), omitted)
        self._keys[key] = (budget, now_s, 0 if passes else omitted + 1)
        if len(self._keys) > _MAX_KEYS:
            self._keys.popitem(last=False)
        return passes


class RecentErrors(logging.Handler):
    """Keeps the newest different warnings and errors of this process, for the administration page."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._newest: deque[tuple[int, str, str]] = deque(maxlen=_MAX_RECENT)

    def emit(self, record: logging.LogRecord) -> None:
        """See ``logging.Handler``."""
        message = record.getMessage()[:_MAX_MESSAGE]
        known = next((line for line in self._newest if line[2] == message), None)
        if known is not None:
            self._newest.remove(known)
        self._newest.append((round(record.created * 1000), record.levelname.lower(), message))

    def lines(self) -> list[tuple[int, str, str]]:
        """Time [ms since 1970], level and message, newest first."""
        return list(self._newest)[::-1]


recent = RecentErrors()


def _context() -> Mapping[str, str]:
    provider = context.get()
    if provider is None:
        return {}
    try:
        return {name: value for name, value in provider().items() if value}
    except Exception:  # noqa: BLE001 (a context that cannot be read must not prevent the line)
        return {}
