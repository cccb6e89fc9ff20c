"""Table 2 of the UR5 paper: latency of one message over HTTP and XMPP, and over current transports."""

import contextlib
import statistics
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.baseline.interleaved import SHARES, Exchange, measure_interleaved, median
from benchmarks.baseline.product import start_peer
from benchmarks.papers import exchanges, http_polling
from benchmarks.reporting.report import Cell, Chart, Claim, Report, Table, percentile
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.network.brokers import HOST, TRANSPORTS, RunningBroker, start_broker
from tests.harness.network.delay import start_delay
from tests.harness.network.ports import free_port
from tests.harness.network.xmpp import start_prosody

HTTP: Final = (
    2762, 3244, 2711, 2859, 3235, 2817, 2935, 2962, 2857, 2999,
    3298, 2931, 3286, 3115, 2776, 2783, 3214, 3032, 3142, 2934,
)  # fmt: skip
XMPP: Final = (
    800, 855, 890, 815, 854, 761, 800, 894, 809, 802, 879, 821, 820, 782, 795, 894, 842, 808, 759, 805,
)  # fmt: skip
"""Published values [ms]."""
SAMPLES: Final = len(HTTP)
SHOWN_RTT_MS: Final = 30
"""Transports whose samples are listed individually."""
LOSS: Final = 0.02
MOSQUITTO: Final = "MQTT, mosquitto"
EMBEDDED: Final = "MQTT, amqtt"
IN_PHASE: Final = "HTTP, polled every 3 s in phase"
ANY_PHASE: Final = "HTTP, polled every 3 s"
LONG_POLL: Final = "HTTP, Telescope's long poll"
ROUNDS: Final = 5
"""Rounds per transport."""


@dataclass(frozen=True)
class Servers:
    """All running servers. ``web`` (polling) and ``relay`` (WebSocket) are reference servers."""

    processes: CloudProcesses
    amqtt: RunningBroker
    prosody: int
    web: int
    relay: int

    @property
    def mosquitto(self) -> RunningBroker:
        """Broker of the product."""
        return self.processes.broker.running

    @property
    def ports(self) -> tuple[int, ...]:
        """Returns the ports of all servers."""
        brokers = (each.port(kind) for each in (self.mosquitto, self.amqtt) for kind in TRANSPORTS)
        return (self.processes.endpoints["server"].port, self.prosody, self.web, self.relay, *brokers)


@dataclass(frozen=True)
class Condition:
    """A network condition and its number of samples per transport."""

    rtt_ms: int
    loss: float
    each: int

    @property
    def name(self) -> str:
        """Returns the name for the report."""
        return f"{self.rtt_ms} ms" + (f", {self.loss:.0%} loss" if self.loss else "")


def conditions(*, quick: bool) -> list[Condition]:
    """Returns the network conditions: four round trips, and packet loss in a full run."""
    counts = {0: 40, 15: 16, 30: 8, 100: 2} if quick else {0: 200, 15: 40, 30: 30, 100: 12}
    found = [Condition(rtt_ms, 0.0, each) for rtt_ms, each in counts.items()]
    lossy = {} if quick else {15: 40, 30: 30, 100: 12}
    return found + [Condition(rtt_ms, LOSS, each) for rtt_ms, each in lossy.items()]


def measure(report: Report, *, quick: bool, log: Callable[[str], None]) -> None:
    """Adds tables, charts and one target per round trip to the report."""
    log("Table 2: starting")
    found: dict[Condition, dict[str, list[float]]] = {}
    with tempfile.TemporaryDirectory() as folder, servers(Path(folder)) as running:
        for condition in conditions(quick=quick):
            found[condition] = with_condition(running, condition, quick=quick)
            log(
                f"Table 2: {condition.name}: "
                + ", ".join(f"{name} {median(each):.4g}" for name, each in found[condition].items())
            )
    show(report, found)


@contextlib.contextmanager
def servers(folder: Path) -> Iterator[Servers]:
    """Starts all servers."""
    unlimited = {"TELESCOPE_RATE_ADDRESS": "0", "TELESCOPE_RATE_KEY": "0", "TELESCOPE_RATE_AGENT": "0"}
    web, relay = free_port(), free_port()
    with contextlib.ExitStack() as stack:
        stack.enter_context(start_peer("benchmarks.papers.relays", "web", str(web)))
        stack.enter_context(start_peer("benchmarks.papers.relays", "socket", str(relay)))
        prosody = stack.enter_context(start_prosody(folder / "prosody", f"http://{HOST}:{web}/verify"))
        amqtt = stack.enter_context(start_broker("amqtt", folder / "amqtt"))
        processes = stack.enter_context(start_cloud_processes("mosquitto", folder / "cloud", unlimited))
        yield Servers(processes, amqtt, prosody.port, web, relay)


def with_condition(running: Servers, condition: Condition, *, quick: bool) -> dict[str, list[float]]:
    """Measures all transports interleaved over one network. A quick run omits MQTT over WebSocket."""
    with contextlib.ExitStack() as stack:
        ports: Mapping[int, int] = {port: port for port in running.ports}
        if condition.rtt_ms or condition.loss:
            network = stack.enter_context(start_delay(*running.ports, rtt_ms=condition.rtt_ms))
            ports = network.ports
        transports = _transports(stack, ports, running, quick=quick)
        long_poll: dict[str, Exchange] = {LONG_POLL: http_polling.long_poll(stack, ports, running.processes)}
        if condition.loss:
            network.set(rtt_ms=condition.rtt_ms, loss=condition.loss)
        polls = _poll(stack, ports[running.web])
        found = measure_interleaved(transports, rounds=ROUNDS, each=condition.each, warm_up=3)
        found |= measure_interleaved(long_poll, rounds=ROUNDS, each=max(2, condition.each // 5), warm_up=1)
        return found | {name: each.result() for name, each in polls.items()}


def _transports(
    stack: contextlib.ExitStack, ports: Mapping[int, int], running: Servers, *, quick: bool
) -> dict[str, Exchange]:
    brokers = {MOSQUITTO: running.mosquitto, EMBEDDED: running.amqtt}
    found = {name: exchanges.mqtt(stack, ports, broker) for name, broker in brokers.items()}
    if not quick:
        for name, broker in brokers.items():
            found[f"{name}, over WebSocket"] = exchanges.mqtt(stack, ports, broker, "websockets")
    return found | {
        "WebSocket, JSON relay": exchanges.web_socket(stack, ports, running.relay),
        "XMPP, Prosody": exchanges.xmpp(stack, ports, running.prosody),
    }


def _poll(stack: contextlib.ExitStack, port: int) -> dict[str, Future[list[float]]]:
    pool = stack.enter_context(ThreadPoolExecutor(2))
    return {
        IN_PHASE: pool.submit(http_polling.pairs, port, SAMPLES, in_phase=True, seed=1),
        ANY_PHASE: pool.submit(http_polling.pairs, port, SAMPLES, in_phase=False, seed=2),
    }


def show(report: Report, found: Mapping[Condition, Mapping[str, list[float]]]) -> None:
    """Adds the results and the published values."""
    shown = next(samples for each, samples in found.items() if each.rtt_ms == SHOWN_RTT_MS and not each.loss)
    report.tables.append(_first_samples(shown))
    report.tables += [_all_samples(condition, samples) for condition, samples in found.items()]
    report.charts.append(_chart(found))
    report.claims += [claim(condition, samples) for condition, samples in found.items() if not condition.loss]


def claim(condition: Condition, samples: Mapping[str, list[float]]) -> Claim:
    """Returns the target: ratio of Telescope to the fastest transport without MQTT."""
    others = {name: median(each) for name, each in samples.items() if not name.startswith("MQTT")}
    best = min(others, key=lambda name: others[name])
    return Claim(
        f"Table 2 at {condition.rtt_ms} ms round trip: MQTT (mosquitto), to the fastest other transport ({best})",
        median(samples[MOSQUITTO]) / others[best],
        1.0,
        "×",
    )


def _first_samples(samples: Mapping[str, list[float]]) -> Table:
    rows: list[list[Cell]] = [
        [
            index + 1,
            HTTP[index],
            XMPP[index],
            *(round(each[index], 1) if index < len(each) else None for each in samples.values()),
        ]
        for index in range(SAMPLES)
    ]
    means = [statistics.fmean(each[:SAMPLES]) for each in (HTTP, XMPP, *samples.values())]
    rows.append(["average", *means])
    return Table(
        title=f"Table 2: 20 messages [ms], published and over {SHOWN_RTT_MS} ms round trip",
        columns=["sample", "published: HTTP", "published: XMPP", *samples],
        rows=rows,
        note="One way, from the sender through a server to the receiver; each has this round trip to the server. "
        "The paper's server was in Singapore; the paper does not state the distance. "
        + " ".join((http_polling.__doc__ or "").split("\n\n")[1].split()),
    )


def _all_samples(condition: Condition, samples: Mapping[str, list[float]]) -> Table:
    best = best_median(samples)
    rows: list[list[Cell]] = [
        [name, len(each), *(percentile(each, share) for share in SHARES.values()), median(each) / best]
        for name, each in samples.items()
    ]
    return Table(
        title=f"All samples, {condition.name}{'' if condition.rtt_ms else ' (loopback)'}",
        columns=["transport", "n", *(f"{share} ms" for share in SHARES), "× the fastest that is not MQTT"],
        rows=rows,
        note=_why(condition, samples),
    )


def _why(condition: Condition, samples: Mapping[str, list[float]]) -> str:
    """Explains the order of the transports."""
    if condition.loss:
        return (
            "A stall delays all following data of the same connection. Polling is hardly affected, because the "
            "polling period dominates."
        )
    slower = [name for name in (MOSQUITTO, EMBEDDED) if median(samples[name]) > best_median(samples)]
    note = (
        f"A setpoint of {len(exchanges.SETPOINT)} bytes, one way. A message over an open connection takes half a "
        "round trip plus processing. Telescope's long poll delivers a whole action (identity, role, rows, signature), "
        "not a bare message."
    )
    if slower:
        note += (
            f" Slower than the fastest other transport: {', '.join(slower)}. A WebSocket relay forwards text to all "
            "other clients; a broker checks topic and permissions of each message, and amqtt does so in Python."
        )
    return note


def best_median(samples: Mapping[str, list[float]]) -> float:
    """Returns the median of the fastest transport without MQTT [ms]."""
    return min(median(each) for name, each in samples.items() if not name.startswith("MQTT"))


def _chart(found: Mapping[Condition, Mapping[str, list[float]]]) -> Chart:
    names = next(iter(found.values()))
    return Chart(
        title="One message, median (Table 2)",
        kind="bar",
        x_label="round trip to the server",
        y_label="ms",
        x=[condition.name for condition in found],
        series={name: [median(samples[name]) for samples in found.values()] for name in names},
        marks={"published: HTTP": statistics.fmean(HTTP), "published: XMPP": statistics.fmean(XMPP)},
        log=True,
    )
