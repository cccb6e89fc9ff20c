"""The command bus over AWS IoT Core: moto, which takes messages and keeps them, behind a wire that can be spoilt."""

import threading
import time
from collections.abc import AsyncIterator, Iterator
from itertools import count
from urllib.parse import parse_qs, unquote, urlsplit

import pytest

from function_app.adapters.aws import command_bus as adapter
from function_app.adapters.aws.command_bus import IotCommandBus
from function_app.ports.command_bus import BusUnavailable
from tests.contract.bus.suite import BEATS, WAITS_IN_VAIN_S, BusContract, Heard, Stage, beats_until
from tests.harness.network.brokers import PATIENCE_S
from tests.harness.stores.aws import REGION, Refusal, Wire, start_moto, start_wire, use_credentials

_spaces = count()
ACCOUNT = "123456789012"


@pytest.fixture(scope="module")
def moto() -> Iterator[str]:
    with start_moto() as endpoint:
        yield endpoint


@pytest.fixture
def wire(moto: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    use_credentials(monkeypatch)
    with start_wire(moto) as wire:
        yield wire


class TestIot(BusContract):
    @pytest.fixture
    async def stage(self, wire: Wire, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Stage]:
        from moto.iotdata.models import iotdata_backends

        monkeypatch.setattr(adapter, "GIVE_UP_S", PATIENCE_S)
        space = f"bus{next(_spaces)}"
        taken = iotdata_backends[ACCOUNT][REGION].published_payloads

        def heard() -> list[Heard]:
            return [Heard(topic, payload) for topic, payload in taken if f"/{space}/" in topic]

        def kept(topic: str) -> bytes | None:
            # moto does not retain: what Amazon is asked to is seen on the wire.
            found = None
            for asked in wire.asked:
                where = urlsplit(asked.path)
                if unquote(where.path) == f"/topics/{topic}" and parse_qs(where.query)["retain"] == ["true"]:
                    found = asked.body
            return found

        bus = IotCommandBus(region=REGION, endpoint=wire.endpoint)
        away = IotCommandBus(region=REGION, endpoint="http://127.0.0.1:1")
        yield Stage(bus, space, heard, kept, away)
        await bus.close()
        await away.close()

    async def test_qos_is_passed_on(self, stage: Stage, wire: Wire) -> None:
        for qos in (0, 1):
            await stage.bus.publish(stage.topic, b"x", qos=qos)
        assert [parse_qs(urlsplit(asked.path).query)["qos"] for asked in wire.asked] == [["0"], ["1"]]

    async def test_a_lost_answer_is_asked_for_again_for_a_device_drops_doubles(self, stage: Stage, wire: Wire) -> None:
        wire.spoil("lose answer")
        await stage.bus.publish(stage.topic, b"x")
        assert set(await stage.until(1)) == {Heard(stage.topic, b"x")}
        assert len(wire.asked) == 2

    @pytest.mark.parametrize(
        ("refusal", "words"),
        [
            (Refusal(403, "ForbiddenException", {}, "application/json"), "AWS IoT Core in .*may not be used.* role"),
            (Refusal(429, "ThrottlingException", {}, "application/json"), "too much to do"),
            (Refusal(400, "InvalidRequestException", {}, "application/json"), "cannot be used"),
        ],
        ids=["rights", "throttled", "invalid"],
    )
    async def test_a_refusal_is_said_in_a_sentence(
        self, stage: Stage, wire: Wire, refusal: Refusal, words: str
    ) -> None:
        wire.spoil(*[refusal] * 3)
        with pytest.raises(BusUnavailable, match=words) as caught:
            await stage.bus.publish(stage.topic, b"x")
        assert "\n" not in str(caught.value)
        assert await stage.bus.status() == str(caught.value)
        assert len(wire.asked) <= 3
        wire.faults.clear()
        await stage.bus.publish(stage.topic, b"x")
        assert await stage.bus.status() == "ok"

    async def test_a_slow_response_delays_no_other_call_and_times_out(
        self, stage: Stage, wire: Wire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        await stage.bus.publish(stage.topic, b"x")
        enough = threading.Event()
        wire.spoil(lambda: enough.wait(WAITS_IN_VAIN_S))
        assert await beats_until(stage.bus.publish(stage.topic, b"x"), enough) >= BEATS
        monkeypatch.setattr(adapter, "GIVE_UP_S", 0.2)
        wire.spoil(lambda: time.sleep(1.0))
        with pytest.raises(BusUnavailable, match="did not answer"):
            await stage.bus.publish(stage.topic, b"x")
