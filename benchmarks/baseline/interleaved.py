"""Timing that stays comparable on a busy machine: the compared paths run interleaved."""

import contextlib
import gc
import random
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from benchmarks.reporting.report import Table, percentile

Exchange = Callable[[], float | None]
"""One round trip. It may return its own duration [ms] if it contains other work. An exception ends the run."""
SHARES: Final = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}


def measure_interleaved(
    paths: Mapping[str, Exchange], *, rounds: int, each: int, warm_up: int = 20, pause_s: float = 0.0
) -> dict[str, list[float]]:
    """Times several paths so that other load on the machine affects all of them equally.

    Args:
        paths: Name → one round trip.
        rounds: Number of rounds; each round runs all paths in a new random order.
        each: Round trips per path and round.
        warm_up: Uncounted round trips per path.
        pause_s: Untimed pause before each round trip [s]. After a pause, processors sleep and caches are cold.
            Compare a paced path only with paths that have the same pause.

    Returns:
        Name → durations [ms], shape (``rounds`` × ``each``,).
    """
    durations_ms: dict[str, list[float]] = {name: [] for name in paths}
    for exchange in paths.values():
        for _ in range(warm_up):
            exchange()
    generator, order = random.Random(1), list(paths)
    with _without_garbage_collection():
        for _ in range(rounds):
            generator.shuffle(order)
            for name in order:
                exchange = paths[name]
                for _ in range(each):
                    time.sleep(pause_s)
                    started_s = time.perf_counter()
                    own_ms = exchange()
                    elapsed_ms = (time.perf_counter() - started_s) * 1000
                    durations_ms[name].append(elapsed_ms if own_ms is None else own_ms)
            gc.collect()
    return durations_ms


@contextlib.contextmanager
def _without_garbage_collection() -> Iterator[None]:
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def table(title: str, durations_ms: Mapping[str, list[float]], *, reference: str = "", note: str = "") -> Table:
    """Returns a table of percentiles per path; with ``reference``, also the ratio of medians to that path."""
    columns = ["path", "n", *(f"{name} ms" for name in SHARES)] + ([f"× {reference}"] if reference else [])
    rows: list[list[str | float | int | None]] = []
    for name, samples in durations_ms.items():
        row: list[str | float | int | None] = [name, len(samples)]
        row += [percentile(samples, share) for share in SHARES.values()]
        if reference:
            row.append(percentile(samples, 0.5) / percentile(durations_ms[reference], 0.5))
        rows.append(row)
    return Table(title=title, columns=columns, rows=rows, note=note)


def median(samples: list[float]) -> float:
    """Returns the middle sample."""
    return percentile(samples, 0.5)
