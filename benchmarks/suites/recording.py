"""Effect of a session's recording on setpoints: two agents, of which one records, measured alternately."""

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.baseline.interleaved import Exchange, measure_interleaved, table
from benchmarks.baseline.product import MeasuredProduct, StreamingOperator, start
from benchmarks.reporting.report import Claim, Report, percentile
from tests.harness.browser.product import enroll
from tests.harness.browser.robots import running_agent
from tests.harness.network.brokers import wait_until

MAX_RATIO: Final = 1.1
_TRIES: Final = 5
_ABOUT: Final = """Two agents with a simulated UR5 each run on one machine. Both have an operator with a lease for the
whole run; one agent records its session at 125 rows a second, the other does not. *Setpoint* is the time from the
operator's publish to the telemetry that reports it as applied. The agents are measured alternately in blocks of ten
setpoints, so other load on the machine affects both; a longer pause between the blocks would end the motion. A setpoint
that is rejected, because the machine has suspended a process for 200 ms, is repeated and not counted. With blocks of
fifty and 1,500 setpoints of each agent, two runs gave 1.18 and 1.55; two agents that both did not record gave 0.82 with
3,000 (2026-11-28). So few setpoints do not show an effect of this size."""
RECORDED, PLAIN = "recorded", "not recorded"
_NAMES: Final = {RECORDED: "recorded", PLAIN: "plain"}


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Measures both agents alternately."""
    report = Report(suite="recording", title="Recording of sessions", quick=quick, about=[_ABOUT])
    rounds, each = (60, 10) if quick else (800, 10)
    with tempfile.TemporaryDirectory() as folder, start(Path(folder), "mosquitto") as product:
        log("starting two agents")
        with agents(product, Path(folder)) as exchanges:
            samples = measure_interleaved(exchanges, rounds=rounds, each=each)
    report.tables.append(table("Setpoints with and without a recording", samples, reference=PLAIN))
    ratio = percentile(samples[RECORDED], 0.99) / percentile(samples[PLAIN], 0.99)
    report.claims.append(Claim("p99 of a setpoint with a recording, to that without", ratio, MAX_RATIO, "×"))
    log(report.claims[-1].line())
    return report


@contextlib.contextmanager
def agents(product: MeasuredProduct, folder: Path) -> Iterator[dict[str, Exchange]]:
    """Yields the exchange of each agent's operator, once the recording is active."""
    with contextlib.ExitStack() as stack:
        owner = stack.enter_context(product.machine.api())
        exchanges: dict[str, Exchange] = {}
        for label, name in _NAMES.items():
            home = folder / name
            enroll(product.machine, owner, home, f"{name}=ur5")
            settings = f"[recording]\nenabled = {str(label == RECORDED).lower()}\nupload = false\n"
            file = home / "agent.toml"
            file.write_text(f"{file.read_text()}\n{settings}")
            stack.enter_context(running_agent(home))
            wait_until(partial(_is_idle, product, name), f"the agent {name}")
            exchanges[label] = partial(_repeated, stack.enter_context(StreamingOperator(product, name)).exchange)
        wait_until(lambda: _state(product, _NAMES[RECORDED]).get("recording"), "the recording")
        yield exchanges


def _repeated(exchange: Callable[[], float]) -> float:
    for _ in range(_TRIES - 1):
        with contextlib.suppress(TimeoutError):
            return exchange()
    return exchange()


def _is_idle(product: MeasuredProduct, name: str) -> bool:
    return _state(product, name).get("mode") == "idle"


def _state(product: MeasuredProduct, name: str) -> dict[str, object]:
    state: dict[str, object] = product.api.device(name)["state"] or {}
    return state
