"""Fig. 6 of Telescope v2: response time of the server when a room client registers."""

import contextlib
import statistics
import tempfile
import uuid
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.baseline.interleaved import Exchange, measure_interleaved
from benchmarks.baseline.product import (
    PAYLOAD,
    TIMEOUT_S,
    HttpConnection,
    MeasuredProduct,
    MqttClient,
    StreamingOperator,
    start,
)
from benchmarks.reporting.report import Cell, Chart, Claim, Report, Table, percentile
from device_agent.ports.clock import CloudClock
from device_agent.protocol.security import signing
from device_agent.transports.http.client import CloudClient
from tests.harness.network.brokers import HOST
from tests.harness.network.delay import start_delay

RTT_MS: Final = 15.0
PRINTED: Final = {"mean": 63.0, "least": 36.0, "most": 103.0}
MEAN_MOST_MS: Final = 20.0
WORST_MOST_MS: Final = 40.0
ANNOUNCED: Final = "agent announces itself and its devices (`POST agents/enroll`)"
_READ: Final = "an account reads a device (`GET devices/{id}`)"
_TOLD: Final = "agent tells the broker, at QoS 1, until confirmed"
_STARTED: Final = "an account starts an action, until the robot has started"
_DEVICES: Final = [
    {"name": "camera", "kind": "camera", "robot_type": "camera", "label": "Camera"},
    {"name": "door", "kind": "door", "robot_type": "door", "label": "Door"},
]
_TOPIC: Final = "bench/figure6"
_ROUNDS: Final = 20


def measure(report: Report, *, quick: bool, say: Callable[[str], None]) -> None:
    """Adds a table, a chart and two targets to the report."""
    say("Fig. 6: starting")
    each, rounds = (5, 10) if quick else (15, 20)
    with tempfile.TemporaryDirectory() as folder:
        wanted = {"TELESCOPE_RATE_KEY": "0", "TELESCOPE_RATE_AGENT": "0", "TELESCOPE_RATE_ACCOUNT": "0"}
        with start(Path(folder), "mosquitto", **wanted) as stand, paths(stand) as found:
            announce = found.pop(ANNOUNCED)
            # The target is the worst of 1,000 samples, so a quick run takes 1,000 as well.
            taken = measure_interleaved({ANNOUNCED: announce}, rounds=_ROUNDS, each=50)
            taken |= measure_interleaved(found, rounds=rounds, each=each)
    judge(report, taken)
    for claim in report.claims[-2:]:
        say(claim.line())


@contextlib.contextmanager
def paths(stand: MeasuredProduct) -> Iterator[dict[str, Exchange]]:
    """Yields all exchanges with open connections and a round trip of 15 ms to server and broker."""
    with contextlib.ExitStack() as stack:
        way = stack.enter_context(start_delay(stand.machine.port, stand.mqtt_port, rtt_ms=RTT_MS))
        web, mqtt = way.ports[stand.machine.port], way.ports[stand.mqtt_port]
        caller = stack.enter_context(HttpConnection(web, {"Authorization": f"Bearer {stand.token}"}))
        line = stack.enter_context(MqttClient(mqtt, *stand.rights(publish=(_TOPIC,)), subscribe=(), qos=1))
        hand = stack.enter_context(StreamingOperator(stand))

        def read() -> None:
            caller.request("GET", f"/api/v1/devices/{hand.device['id']}")

        def tell() -> None:
            line.client.publish(_TOPIC, PAYLOAD, 1).wait_for_publish(TIMEOUT_S)

        yield {
            ANNOUNCED: _announce(stand, f"http://{HOST}:{web}"),
            _READ: read,
            _TOLD: tell,
            _STARTED: partial(hand.run_action, caller),
        }


def _announce(stand: MeasuredProduct, server: str) -> Exchange:
    """Registers a paired room agent with its own HTTP client and signing key, as the real agent does."""
    api = CloudClient(server, signing.generate(), CloudClock())

    def announce() -> None:
        api.enroll(name="room", software=f"bench {uuid.uuid4().hex[:8]}", transport="mqtt", devices=_DEVICES)

    claim = api.enroll(name="room", software="bench", transport="mqtt", devices=_DEVICES)
    with stand.machine.api() as person:
        person.post("/agents/claim", {"code": claim.code})
    return announce


def judge(report: Report, taken: dict[str, list[float]]) -> None:
    """Adds the results beside the published values."""
    rows: list[list[Cell]] = [["printed for Telescope v2", None, *PRINTED.values(), None, None]]
    for name, found in taken.items():
        marks = (percentile(found, 0.5), percentile(found, 0.99))
        rows.append([name, len(found), statistics.fmean(found), min(found), max(found), *marks])
    report.tables.append(
        Table(
            title="Request and response of a room client, 15 ms of round trip from the cloud (Fig. 6)",
            columns=["exchange", "n", "mean ms", "least ms", "most ms", "p50 ms", "p99 ms"],
            rows=rows,
            note="Printed: over a network of about 15 ms, a client that registers its name, its connection and its "
            "devices, until it hears that this was right. The first row of ours is that exchange; its connection is "
            "warm, its request signed, its answer comes when the row is written. Over mosquitto, beside a simulated "
            "arm with its agent on the same two cores; only the client is behind the delay.",
        )
    )
    report.charts.append(
        Chart(
            title="Request and response, 15 ms from the cloud (Fig. 6)",
            kind="cdf",
            x_label="ms",
            y_label="share of the samples",
            x=[],
            series={name.partition(" (")[0]: list(found) for name, found in taken.items()},
        )
    )
    found = taken[ANNOUNCED]
    report.claims += [
        Claim(
            "request and response of a room client behind 15 ms of round trip, on average (printed: 63)",
            statistics.fmean(found),
            MEAN_MOST_MS,
            "ms",
        ),
        Claim(
            f"the same exchange of a room client, the worst of {len(found):,} (printed: 103)",
            max(found),
            WORST_MOST_MS,
            "ms",
        ),
    ]
