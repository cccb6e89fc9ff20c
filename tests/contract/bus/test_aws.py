"""The command bus over AWS IoT Core: moto, which stores messages, behind a proxy that injects faults."""

import threading
import time
from collections.abc import Iterator
from urllib.parse import parse_qs, unquote, urlsplit

import pytest
from moto.iotdata.models import iotdata_backends

from function_app.adapters.aws.command_bus import IotCommandBus
from function_app.adapters.shared import publishing_bus
from function_app.ports.command_bus import BusUnavailable
from tests.contract.bus.suite import MAX_BLOCKED_S, BusContract, Sent, Stage, assert_loop_is_free
from tests.contract.conftest import Closing
from tests.harness.network.brokers import PATIENCE_S
from tests.harness.stores.aws import REGION, FaultProxy, Refusal, start_fault_proxy

ACCOUNT = "123456789012"


@pytest.fixture
def proxy(moto: str) -> Iterator[FaultProxy]:
    with start_fault_proxy(moto) as proxy:
        yield proxy


class TestIot(BusContract):
    @pytest.fixture
    def stage(self, proxy: FaultProxy, space: str, closing: Closing, monkeypatch: pytest.MonkeyPatch) -> Stage:
        monkeypatch.setattr(publishing_bus, "GIVE_UP_S", PATIENCE_S)
        taken = iotdata_backends[ACCOUNT][REGION].published_payloads

        def sent() -> list[Sent]:
            return [Sent(topic, payload) for topic, payload in taken if f"/{space}/" in topic]

        def retained(topic: str) -> bytes | None:
            # moto does not retain messages, so the requests are checked.
            newest = None
            for request in proxy.requests:
                url = urlsplit(request.path)
                if unquote(url.path) == f"/topics/{topic}" and parse_qs(url.query)["retain"] == ["true"]:
                    newest = request.body
            return newest

        bus, unreachable = (
            closing(IotCommandBus(region=REGION, endpoint=endpoint))
            for endpoint in (proxy.endpoint, "http://127.0.0.1:1")
        )
        return Stage(bus, space, sent, retained, unreachable)

    async def test_qos_is_forwarded(self, stage: Stage, proxy: FaultProxy) -> None:
        for qos in (0, 1):
            await stage.bus.publish(stage.topic, b"x", qos=qos)
        assert [parse_qs(urlsplit(request.path).query)["qos"] for request in proxy.requests] == [["0"], ["1"]]

    async def test_a_message_without_response_is_sent_again(self, stage: Stage, proxy: FaultProxy) -> None:
        proxy.inject("lose response")  # a device drops duplicates
        await stage.bus.publish(stage.topic, b"x")
        assert set(await stage.until(1)) == {Sent(stage.topic, b"x")}
        assert len(proxy.requests) == 2

    @pytest.mark.parametrize(
        ("refusal", "words"),
        [
            (Refusal(403, "ForbiddenException", {}, "application/json"), "AWS IoT Core in .*denied access.* role"),
            (Refusal(429, "ThrottlingException", {}, "application/json"), "is overloaded"),
            (Refusal(400, "InvalidRequestException", {}, "application/json"), "cannot be used"),
        ],
        ids=["rights", "throttled", "invalid"],
    )
    async def test_a_rejection_is_reported_in_one_sentence(
        self, stage: Stage, proxy: FaultProxy, refusal: Refusal, words: str
    ) -> None:
        proxy.inject(*[refusal] * 3)
        with pytest.raises(BusUnavailable, match=words) as caught:
            await stage.bus.publish(stage.topic, b"x")
        assert "\n" not in str(caught.value)
        assert await stage.bus.status() == str(caught.value)
        assert len(proxy.requests) <= 3
        proxy.faults.clear()
        await stage.bus.publish(stage.topic, b"x")
        assert await stage.bus.status() == "ok"

    async def test_a_slow_response_delays_no_other_call_and_times_out(
        self, stage: Stage, proxy: FaultProxy, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        await stage.bus.publish(stage.topic, b"x")
        release = threading.Event()
        proxy.inject(lambda: release.wait(MAX_BLOCKED_S))
        await assert_loop_is_free(stage.bus.publish(stage.topic, b"x"), release)
        monkeypatch.setattr(publishing_bus, "GIVE_UP_S", 0.2)
        proxy.inject(lambda: time.sleep(1.0))
        with pytest.raises(BusUnavailable, match="did not answer"):
            await stage.bus.publish(stage.topic, b"x")
