"""The metrics of an agent: what passes is counted, and what exists is read on request."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol import Event, codec
from device_agent.runtime.storage.outbox_store import OutboxItem, OutboxStore
from device_agent.runtime.telemetry.outbox import Outbox
from device_agent.transports.metrics import AgentMetrics

ARM = "ts/v1/s/a/arm"


class Link:
    def __init__(self) -> None:
        self.sent: list[str] = []
        self.stopped = False

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        self.receive, self.link_changed = receive, link_changed

    def publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> bool:
        self.sent.append(topic)
        return bool(payload or qos or retain or delivered)

    def stop(self) -> None:
        self.stopped = True


def value(metrics: AgentMetrics, name: str, **labels: str) -> Any:
    return metrics.registry.get_sample_value(name, labels)


def held(code: str, number: str, kind: str = "motion-held") -> bytes:
    return codec.encode(
        Event(id=number, device="arm", at_ms=1, kind=kind, severity="info", message="motion-held", data={"code": code})
    )


@pytest.fixture
def metrics() -> AgentMetrics:
    return AgentMetrics()


def test_messages_and_connections_are_counted_and_passed_on(metrics: AgentMetrics) -> None:
    link, received, changes = Link(), list[str](), list[bool]()
    transport = metrics.measured(link)
    transport.start(lambda topic, _: received.append(topic), changes.append)
    for topic in (f"{ARM}/ctl/1", f"{ARM}/ctl/1", f"{ARM}/cmd"):
        link.receive(topic, b"")
    for up in (True, False, True):
        link.link_changed(up)
    assert not transport.publish(f"{ARM}/state", b"", qos=0)
    transport.stop()
    assert value(metrics, "telescope_agent_setpoints_received_total") == 2
    assert value(metrics, "telescope_agent_connections_total") == 2
    assert value(metrics, "telescope_agent_connected") == 1
    assert (len(received), changes, link.sent, link.stopped) == (3, [True, False, True], [f"{ARM}/state"], True)


def test_each_hold_is_counted_once_by_its_reason(metrics: AgentMetrics) -> None:
    for payload in (
        held("watchdog", "1"), held("watchdog", "1"), held("watchdog", "2"), held("lease_lost", "3"),
        held("watchdog", "4", kind="action-lost"), b"motion-held", b"",
    ):  # fmt: skip
        metrics.sent(f"{ARM}/event", payload)
    metrics.sent(f"{ARM}/state", held("watchdog", "5"))
    assert value(metrics, "telescope_agent_motion_held_total", reason="watchdog") == 2
    assert value(metrics, "telescope_agent_motion_held_total", reason="lease_lost") == 1


def test_periods_are_measured_and_still_govern_the_load(metrics: AgentMetrics) -> None:
    for period in range(200):
        metrics.load.record_period(period * 0.02, late_s=0.03, period_s=0.02)
    metrics.load.record_period(4.02, late_s=-1e-9, period_s=0.02)
    assert value(metrics, "telescope_agent_period_lateness_seconds_count") == 201
    assert value(metrics, "telescope_agent_period_lateness_seconds_bucket", le="0.0005") == 1
    assert value(metrics, "telescope_agent_period_seconds") == 0.02
    assert value(metrics, "telescope_agent_load_level") == metrics.load.level > 0


def test_rejections_of_all_devices_and_the_outbox_are_read(metrics: AgentMetrics, tmp_path: Path) -> None:
    assert value(metrics, "telescope_agent_outbox_bytes") == 0
    store = OutboxStore(tmp_path / "outbox.db", own="ts/v1/s/a/", max_bytes=10**6, max_age_ms=10**15)
    store.open()
    store.put([OutboxItem(f"{ARM}/event", b"{}", 1, late=False)], now_ms=1)
    devices: Any = {
        name: SimpleNamespace(publisher=SimpleNamespace(rejections=counts))
        for name, counts in {"arm": {"too_old": 2, "no_lease": 1}, "head": {"too_old": 3}}.items()
    }
    metrics.read_from(devices, Outbox(store, publish=lambda *_, **__: True, device_topic=ARM))
    assert value(metrics, "telescope_agent_rejections_total", reason="too_old") == 5
    assert value(metrics, "telescope_agent_rejections_total", reason="no_lease") == 1
    assert value(metrics, "telescope_agent_outbox_bytes") == store.stored_bytes > 0
    store.close()
