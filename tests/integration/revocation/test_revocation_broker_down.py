"""Access revocation while the broker cannot be reached."""

import asyncio
import contextlib
import logging
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import ReleaseLease
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired, problem, settings
from tests.harness.network.brokers import RunningBroker, start_broker, wait_until
from tests.integration.revocation.connections import connect, request_credentials

_log = logging.getLogger(__name__)


@dataclass
class Site:
    """Functions with a separate broker that can be stopped and restarted."""

    home: Path
    folder: Path
    broker: RunningBroker
    cloud: Cloud
    stack: contextlib.ExitStack

    def restart_broker(self) -> None:
        previous, keys = self.broker, self.home / "keys" / "public.json"
        again = start_broker(
            previous.kind, self.folder, keys=keys, tcp_port=previous.tcp_port, websocket_port=previous.websocket_port
        )
        self.broker = self.stack.enter_context(again)


@pytest.fixture
def site(request: pytest.FixtureRequest, home: Path, tmp_path: Path) -> Iterator[Site]:
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(start_broker(request.param, tmp_path / "b", keys=home / "keys" / "public.json"))
        if broker.kind == "mosquitto":
            (home / "mosquitto").mkdir()
            shutil.copy(broker.home / "service.password", home / "mosquitto")
        cloud = stack.enter_context(Cloud(settings(home, broker)))
        cloud.start_ingest()
        yield Site(home, tmp_path / "b", broker, cloud, stack)


@pytest.mark.parametrize(
    ("site", "then"), [("amqtt", "offline"), ("mosquitto", "offline"), ("amqtt", "owner")], indirect=["site"]
)
def test_ending_a_share_while_the_broker_is_down_responds_immediately_and_takes_effect_later(
    site: Site, then: str
) -> None:
    """``then``: the person who takes control before the broker is restarted."""
    cloud = site.cloud
    with paired(cloud) as (anna, robot):
        bert = cloud.sign_in("bert")
        at = f"/devices/{robot.device}/shares"
        anna.post(at, {"account": "bert", "role": "operator"})
        epoch = bert.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
        running = bert.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
        issued = [
            request_credentials(bert, purpose="view"),
            request_credentials(bert, purpose="control", device=robot.device, epoch=epoch),
        ]
        site.broker.stop()
        requested_s = time.monotonic()
        answer = anna.delete(f"{at}/{bert.account}")
        _log.warning("%s is down: response after %.1f s", site.broker.kind, time.monotonic() - requested_s)
        assert answer.status_code == 202, answer.text
        assert "broker" in answer.json()["detail"]
        problem(bert.get(f"/devices/{robot.device}"), 404, "device-unknown")
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
        assert anna.action(running)["reason"]["code"] == "unshared"
        if then == "owner":
            assert anna.take_lease(robot.device).json()["epoch"] == epoch + 2
        site.restart_broker()
        if then == "offline":
            robot.connect()

        def completed() -> bool:
            cloud.clock.advance(1)
            cloud.sweep()
            pages = (cloud.run(cloud.functions.tables.query(records.PENDING, str(n))) for n in range(SHARDS))
            return not any("share-changed" in row.key for page in pages for row in page.rows)

        wait_until(completed, "the timer to revoke the credentials at the broker")
        for client_id, credentials in issued:
            with site.broker.connect(client_id, credentials) as late:
                assert not late.connected.is_set(), "revoked credentials"
        if then == "offline":
            wait_until(lambda: robot.received(ReleaseLease), "the end of control at the robot")
            assert robot.received(ReleaseLease)[-1].epoch == epoch + 1


def test_an_unresponsive_broker_does_not_delay_requests(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, broker: RunningBroker, operator: tuple[Person, Person, Robot]
) -> None:
    anna, bert, robot = operator
    at = f"/devices/{robot.device}/shares"
    epoch = bert.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
    bert.start(robot.device, epoch=epoch, wait_ms=10_000)
    page = connect(broker, bert, purpose="view")

    async def never(*_: Any, **__: Any) -> None:
        await asyncio.Event().wait()

    with monkeypatch.context() as patch:
        patch.setattr("function_app.services.sharing.access_revocation.NOTIFY_S", 0.2)
        patch.setattr(cloud.functions.access, "revoke", never)
        patch.setattr(cloud.functions.bus, "publish", never)
        answer = anna.post(at, {"account": "bert", "role": "viewer"})
    assert (answer.status_code, answer.json()["role"]) == (202, "viewer")
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert not page.disconnected.is_set()
    cloud.clock.advance(2)
    cloud.sweep()
    wait_until(page.disconnected.is_set, "the end of the connection")
    page.close()
    assert anna.post(at, {"account": "bert", "role": "viewer"}).status_code == 200
