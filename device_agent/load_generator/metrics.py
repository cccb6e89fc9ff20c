"""Counters of a load test, printed regularly and as one object at the end."""

import math
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from msgspec import Struct
from msgspec.structs import asdict, replace

_MAX_SAMPLES = 200_000


class Counts(Struct):
    """Counters since the start.

    Attributes:
        out: Messages sent; ``out_bytes``: size of their topics and payloads.
        received: Messages received; ``in_bytes``: size of their topics and payloads.
        out_qos1: Messages sent at QoS 1; ``confirmed``: those that the broker acknowledged.
        missed: Measurements that were not sent because the process was late.
        dropped: Messages that could not be sent.
        lost_links: Connections that were lost.
        refused: Messages that robots rejected.
    """

    out: int = 0
    out_bytes: int = 0
    received: int = 0
    in_bytes: int = 0
    out_qos1: int = 0
    confirmed: int = 0
    missed: int = 0
    dropped: int = 0
    lost_links: int = 0
    refused: int = 0


class Metrics:
    """Metrics of a run. Not thread-safe: only the event loop uses them.

    Attributes:
        counts: Counters since the start.
        connected: Current number of connections; ``most_connected``: its maximum.
        lag_ms: Delays of the event loop since the last line; ``confirm_ms``: times until the broker acknowledged.
        errors: Connection errors and their counts.
    """

    def __init__(self, agents: int) -> None:
        self.agents = agents
        self.counts = Counts()
        self.connected = 0
        self.most_connected = 0
        self.lag_ms: list[float] = []
        self.confirm_ms: list[float] = []
        self.errors: Counter[str] = Counter()
        self._all_lag_ms: list[float] = []
        self._all_confirm_ms: list[float] = []
        self._start_s = self._line_s = time.monotonic()
        self._previous = Counts()
        self._steady: tuple[float, float, Counts] | None = None

    def record_connected(self) -> None:
        """Count an established connection."""
        self.connected += 1
        self.most_connected = max(self.most_connected, self.connected)

    def record_error(self, text: str) -> None:
        """Count a connection error."""
        self.errors[text[:200]] += 1

    def start_steady(self) -> None:
        """Start the steady phase: the rates of the summary start here."""
        self.lag_ms.clear()
        self.confirm_ms.clear()
        self._all_lag_ms.clear()
        self._all_confirm_ms.clear()
        self._steady = (time.monotonic(), time.process_time(), replace(self.counts))

    def line(self, memory_bytes: float) -> str:
        """One line with changes since the previous one."""
        now_s = time.monotonic()
        elapsed_s = max(now_s - self._line_s, 1e-9)
        now, before = self.counts, self._previous
        lag, confirm = percentile(self.lag_ms, 99), percentile(self.confirm_ms, 99)
        self._collect()
        self._line_s, self._previous = now_s, replace(now)
        text = (
            f"{now_s - self._start_s:6.0f} s  {self.connected} of {self.agents} connected  "
            f"{(now.out - before.out) / elapsed_s:.1f} out/s  {(now.received - before.received) / elapsed_s:.1f} in/s  "
            f"{(now.out_bytes - before.out_bytes) / elapsed_s / 1000:.1f} kB/s  lag p99 {_ms(lag)}  "
            f"confirmed p99 {_ms(confirm)}  missed {now.missed - before.missed}  "
            f"{memory_bytes / max(self.agents, 1) / 1000:.0f} kB per agent"
        )
        if self.errors:
            message, times = self.errors.most_common(1)[0]
            text += f"  most frequent error: {message} ({times} times)"
        return text

    def summary(self, memory_bytes: float) -> dict[str, Any]:
        """All metrics, for programs; rates are since ``start_steady``."""
        self._collect()
        since_s, cpu_s, before = self._steady or (self._start_s, 0.0, Counts())
        elapsed_s = max(time.monotonic() - since_s, 1e-9)
        now = self.counts
        return {
            "agents": self.agents,
            "most_connected": self.most_connected,
            "measured_s": round(elapsed_s, 3),
            "out_per_s": round((now.out - before.out) / elapsed_s, 3),
            "in_per_s": round((now.received - before.received) / elapsed_s, 3),
            "out_bytes_per_message": round((now.out_bytes - before.out_bytes) / max(now.out - before.out, 1), 1),
            "missed_share": round(
                (now.missed - before.missed) / max(now.missed - before.missed + now.out - before.out, 1), 6
            ),
            "unconfirmed": now.out_qos1 - now.confirmed,
            "cpu_share": round((time.process_time() - cpu_s) / elapsed_s, 3),
            "lag_ms": _percentiles(self._all_lag_ms),
            "confirm_ms": _percentiles(self._all_confirm_ms),
            "memory_bytes_per_agent": round(memory_bytes / max(self.agents, 1)),
            "counts": asdict(now),
            "errors": dict(self.errors.most_common(10)),
        }

    def _collect(self) -> None:
        for recent, total in ((self.lag_ms, self._all_lag_ms), (self.confirm_ms, self._all_confirm_ms)):
            total.extend(recent[: _MAX_SAMPLES - len(total)])
            recent.clear()


def percentile(values: Sequence[float], percent: float) -> float | None:
    """The smallest value that the given percentage does not exceed, or ``None``."""
    if not values:
        return None
    return sorted(values)[max(0, math.ceil(percent / 100 * len(values)) - 1)]


def _percentiles(values: Sequence[float]) -> dict[str, float | int | None]:
    values_ms = {f"p{percent}": percentile(values, percent) for percent in (50, 99, 100)}
    return {name: None if value is None else round(value, 3) for name, value in values_ms.items()} | {
        "count": len(values)
    }


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} ms"
