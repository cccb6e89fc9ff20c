"""Counters of a load test, printed regularly and as one object at the end."""

import math
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from msgspec import Struct
from msgspec.structs import asdict, replace

_MOST_SAMPLES = 200_000


class Counts(Struct):
    """Counters since the start.

    Attributes:
        out: Messages handed to the broker; ``out_bytes``: their topics and payloads; ``heard``, ``heard_bytes``: come.
        confirmed: Of those at QoS 1, confirmed by the broker; ``asked``: at QoS 1 at all.
        missed: Measurements that were due and left out because the process was behind.
        dropped: Messages that had no link to go over.
        lost_links: Links that ended by themselves.
        refused: Messages that robots did not obey.
    """

    out: int = 0
    out_bytes: int = 0
    heard: int = 0
    heard_bytes: int = 0
    asked: int = 0
    confirmed: int = 0
    missed: int = 0
    dropped: int = 0
    lost_links: int = 0
    refused: int = 0


class Metrics:
    """All metrics of a run. Only the event loop uses them, except for ``trouble``.

    Attributes:
        counts: So far.
        connected: Links that are up now; ``most_connected``: at once, so far.
        lag_ms: How late the event loop came, since the last line; ``confirm_ms``: until the broker confirmed.
        troubles: What went wrong with links, and how often.
    """

    def __init__(self, agents: int) -> None:
        self.agents = agents
        self.counts = Counts()
        self.connected = 0
        self.most_connected = 0
        self.lag_ms: list[float] = []
        self.confirm_ms: list[float] = []
        self.troubles: Counter[str] = Counter()
        self._all_lag_ms: list[float] = []
        self._all_confirm_ms: list[float] = []
        self._began_s = self._line_s = time.monotonic()
        self._before = Counts()
        self._steady: tuple[float, float, Counts] | None = None

    def up(self) -> None:
        """Count an established link."""
        self.connected += 1
        self.most_connected = max(self.most_connected, self.connected)

    def trouble(self, text: str) -> None:
        """Count a link error."""
        self.troubles[text[:200]] += 1

    def steady(self) -> None:
        """Start the steady phase: final rates are counted from here."""
        self.lag_ms.clear()
        self.confirm_ms.clear()
        self._all_lag_ms.clear()
        self._all_confirm_ms.clear()
        self._steady = (time.monotonic(), time.process_time(), replace(self.counts))

    def line(self, memory_bytes: float) -> str:
        """One line with changes since the previous one."""
        now_s = time.monotonic()
        passed_s = max(now_s - self._line_s, 1e-9)
        now, before = self.counts, self._before
        lag, confirm = percentile(self.lag_ms, 99), percentile(self.confirm_ms, 99)
        self._gather()
        self._line_s, self._before = now_s, replace(now)
        text = (
            f"{now_s - self._began_s:6.0f} s  {self.connected} of {self.agents} connected  "
            f"{(now.out - before.out) / passed_s:.1f} out/s  {(now.heard - before.heard) / passed_s:.1f} in/s  "
            f"{(now.out_bytes - before.out_bytes) / passed_s / 1000:.1f} kB/s  lag p99 {_ms(lag)}  "
            f"confirmed p99 {_ms(confirm)}  missed {now.missed - before.missed}  "
            f"{memory_bytes / max(self.agents, 1) / 1000:.0f} kB an agent"
        )
        if self.troubles:
            worst, times = self.troubles.most_common(1)[0]
            text += f"  trouble: {worst} ({times} times)"
        return text

    def summary(self, memory_bytes: float) -> dict[str, Any]:
        """All metrics, for programs; rates are since ``steady``."""
        self._gather()
        since_s, cpu_s, before = self._steady or (self._began_s, 0.0, Counts())
        passed_s = max(time.monotonic() - since_s, 1e-9)
        now = self.counts
        return {
            "agents": self.agents,
            "most_connected": self.most_connected,
            "measured_s": round(passed_s, 3),
            "out_per_s": round((now.out - before.out) / passed_s, 3),
            "in_per_s": round((now.heard - before.heard) / passed_s, 3),
            "out_bytes_per_message": round((now.out_bytes - before.out_bytes) / max(now.out - before.out, 1), 1),
            "missed_share": round(
                (now.missed - before.missed) / max(now.missed - before.missed + now.out - before.out, 1), 6
            ),
            "unconfirmed": now.asked - now.confirmed,
            "cpu_share": round((time.process_time() - cpu_s) / passed_s, 3),
            "lag_ms": _spread(self._all_lag_ms),
            "confirm_ms": _spread(self._all_confirm_ms),
            "memory_bytes_per_agent": round(memory_bytes / max(self.agents, 1)),
            "counts": asdict(now),
            "troubles": dict(self.troubles.most_common(10)),
        }

    def _gather(self) -> None:
        for mine, whole in ((self.lag_ms, self._all_lag_ms), (self.confirm_ms, self._all_confirm_ms)):
            whole.extend(mine[: _MOST_SAMPLES - len(whole)])
            mine.clear()


def percentile(values: Sequence[float], percent: float) -> float | None:
    """The smallest value that the given percentage does not exceed, or ``None``."""
    if not values:
        return None
    return sorted(values)[max(0, math.ceil(percent / 100 * len(values)) - 1)]


def _spread(values: Sequence[float]) -> dict[str, float | int | None]:
    known = {f"p{percent}": percentile(values, percent) for percent in (50, 99, 100)}
    return {name: None if value is None else round(value, 3) for name, value in known.items()} | {"count": len(values)}


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} ms"
