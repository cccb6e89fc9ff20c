"""Fair timing on a machine that is never quite at rest: what is to be compared takes turns."""

import contextlib
import gc
import random
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from benchmarks.reporting.report import Table, percentile

Exchange = Callable[[], float | None]
"""One round trip; where more than that has to be done, it gives its own time [ms]. Whatever it raises ends the run."""
SHARES: Final = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "most": 1.0}


def measure_interleaved(
    paths: Mapping[str, Exchange], *, rounds: int, each: int, warm_up: int = 20, pause_s: float = 0.0
) -> dict[str, list[float]]:
    """Time several paths so that what else the machine does falls on all of them alike.

    Args:
        paths: Name → one round trip.
        rounds: How often all paths have their turn, in a new order each time.
        each: Round trips in a turn.
        warm_up: Round trips of each path that are not counted.
        pause_s: Before each round trip, outside of its time. What comes after a pause finds sleeping processors and
            cold caches, so what is paced by nature is to be compared with what is paced alike.

    Returns:
        Name → how long each round trip took [ms], ``rounds`` × ``each`` of them.
    """
    found: dict[str, list[float]] = {name: [] for name in paths}
    for exchange in paths.values():
        for _ in range(warm_up):
            exchange()
    chance, order = random.Random(1), list(paths)
    with _no_collector():
        for _ in range(rounds):
            chance.shuffle(order)
            for name in order:
                exchange, taken = paths[name], found[name]
                for _ in range(each):
                    time.sleep(pause_s)
                    began = time.perf_counter()
                    own = exchange()
                    taken.append((time.perf_counter() - began) * 1000 if own is None else own)
            gc.collect()
    return found


@contextlib.contextmanager
def _no_collector() -> Iterator[None]:
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def table(title: str, found: Mapping[str, list[float]], *, against: str = "", note: str = "") -> Table:
    """Percentiles of each path [ms]; with ``against``, medians as ratios to that path's."""
    columns = ["path", "n", *(f"{name} ms" for name in SHARES)] + ([f"× {against}"] if against else [])
    rows: list[list[str | float | int | None]] = []
    for name, taken in found.items():
        row: list[str | float | int | None] = [name, len(taken)]
        row += [percentile(taken, share) for share in SHARES.values()]
        if against:
            row.append(percentile(taken, 0.5) / percentile(found[against], 0.5))
        rows.append(row)
    return Table(title=title, columns=columns, rows=rows, note=note)


def median(taken: list[float]) -> float:
    """The sample in the middle."""
    return percentile(taken, 0.5)
