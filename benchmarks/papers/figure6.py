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
PUBLISHED: Final = {"mean": 63.0, "min": 36.0, "max": 103.0}
MAX_MEAN_MS: Final = 20.0
MAX_MS: Final = 40.0
ENROLLED: Final = "agent registers itself and its devices (`POST agents/enroll`)"
_READ: Final = "an account reads a device (`GET devices/{id}`)"
_PUBLISHED: Final = "agent publishes with QoS 1, until the broker confirms"
_STARTED: Final = "an account starts an action, until the robot starts"
_DEVICES: Final = [
    {"name": "camera", "kind": "camera", "robot_type": "camera", "label": "Camera"},
    {"name": "door", "kind": "door", "robot_type": "door", "label": "Door"},
]
_TOPIC: Final = "bench/figure6"
_ROUNDS: Final = 20


def measure(report: Report, *, quick: bool, log: Callable[[str], None]) -> None:
    """Adds a table, a chart and two targets to the report."""
    log("Fig. 6: starting")
    each, rounds = (5, 10) if quick else (15, 20)
    with tempfile.TemporaryDirectory() as folder:
        unlimited = {"TELESCOPE_RATE_KEY": "0", "TELESCOPE_RATE_AGENT": "0", "TELESCOPE_RATE_ACCOUNT": "0"}
        with start(Path(folder), "mosquitto", **unlimited) as product, paths(product) as found:
            enroll = found.pop(ENROLLED)
            # The target is the worst of 1,000 samples, so a quick run takes 1,000 as well.
            samples = measure_interleaved({ENROLLED: enroll}, rounds=_ROUNDS, each=50)
            samples |= measure_interleaved(found, rounds=rounds, each=each)
    add_results(report, samples)
    for claim in report.claims[-2:]:
        log(claim.line())


@contextlib.contextmanager
def paths(product: MeasuredProduct) -> Iterator[dict[str, Exchange]]:
    """Yields all exchanges with open connections and a round trip of 15 ms to server and broker."""
    with contextlib.ExitStack() as stack:
        network = stack.enter_context(start_delay(product.machine.port, product.mqtt_port, rtt_ms=RTT_MS))
        web, mqtt = network.ports[product.machine.port], network.ports[product.mqtt_port]
        caller = stack.enter_context(HttpConnection(web, {"Authorization": f"Bearer {product.token}"}))
        client = stack.enter_context(MqttClient(mqtt, *product.credentials(publish=(_TOPIC,)), subscribe=(), qos=1))
        operator = stack.enter_context(StreamingOperator(product))

        def read() -> None:
            caller.request("GET", f"/api/v1/devices/{operator.device['id']}")

        def publish() -> None:
            client.client.publish(_TOPIC, PAYLOAD, 1).wait_for_publish(TIMEOUT_S)

        yield {
            ENROLLED: _enroll(product, f"http://{HOST}:{web}"),
            _READ: read,
            _PUBLISHED: publish,
            _STARTED: partial(operator.run_action, caller),
        }


def _enroll(product: MeasuredProduct, server: str) -> Exchange:
    """Registers a paired room agent with its own HTTP client and signing key, as the agent does."""
    api = CloudClient(server, signing.generate(), CloudClock())

    def enroll() -> None:
        api.enroll(name="room", software=f"bench {uuid.uuid4().hex[:8]}", transport="mqtt", devices=_DEVICES)

    claim = api.enroll(name="room", software="bench", transport="mqtt", devices=_DEVICES)
    with product.machine.api() as owner:
        owner.post("/agents/claim", {"code": claim.code})
    return enroll


def add_results(report: Report, samples: dict[str, list[float]]) -> None:
    """Adds the results and the published values."""
    rows: list[list[Cell]] = [["published for Telescope v2", None, *PUBLISHED.values(), None, None]]
    for name, found in samples.items():
        percentiles = (percentile(found, 0.5), percentile(found, 0.99))
        rows.append([name, len(found), statistics.fmean(found), min(found), max(found), *percentiles])
    report.tables.append(
        Table(
            title="Request and response of a room client, 15 ms round trip to the cloud (Fig. 6)",
            columns=["exchange", "n", "mean ms", "min ms", "max ms", "p50 ms", "p99 ms"],
            rows=rows,
            note="Published: a client registers its name, connection and devices over a network of about 15 ms and "
            "waits for the confirmation. The second row is the same exchange over an open connection: the request is "
            "signed, and the response is sent after the row is written. Over mosquitto, with a simulated arm and its "
            "agent on the same two cores; only the client is behind the delay.",
        )
    )
    report.charts.append(
        Chart(
            title="Request and response, 15 ms round trip (Fig. 6)",
            kind="cdf",
            x_label="ms",
            y_label="share of the samples",
            x=[],
            series={name.partition(" (")[0]: list(found) for name, found in samples.items()},
        )
    )
    found = samples[ENROLLED]
    report.claims += [
        Claim(
            "request and response of a room client, 15 ms round trip, mean (published: 63)",
            statistics.fmean(found),
            MAX_MEAN_MS,
            "ms",
        ),
        Claim(
            f"the same exchange of a room client, maximum of {len(found):,} (published: 103)", max(found), MAX_MS, "ms"
        ),
    ]
