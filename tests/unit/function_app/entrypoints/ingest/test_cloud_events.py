"""Cloud events are stored like messages of a broker; after a store error they are delivered again."""

import base64
import contextlib
import json
from copy import copy
from types import SimpleNamespace
from typing import Any

import pytest

from device_agent.protocol import Event, Measurements, Mode, State, codec, topics
from function_app.entrypoints.ingest import cloud_events
from function_app.ports.tables import StoreError
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud


def state(tick_ms: int) -> bytes:
    return codec.encode(State(device="arm", at_ms=1, tick_ms=tick_ms, mode=Mode.IDLE, epoch=0))


EVENT = Event(id="e1", device="arm", at_ms=1, kind="tested", severity="info", message="x")


def tick(cloud: Cloud, robot: Robot) -> int | None:
    """The tick of the state that the API returns."""
    stored = cloud.sign_in("anna").get(f"/devices/{robot.device}").json()["state"]
    return None if stored is None else int(stored["tick_ms"])


def cloud_event(topic: str, payload: bytes, **changes: Any) -> dict[str, Any]:
    """A message without content type, as the namespace routes it."""
    return {
        "specversion": "1.0",
        "id": "9aeb0fdf-c01e-0131-0922-9eb54906e20",
        "type": "MQTT.EventPublished",
        "subject": topic,
        "data_base64": base64.b64encode(payload).decode(),
        **changes,
    }


def rule_event(topic: str, payload: bytes) -> dict[str, Any]:
    return {"payload": base64.b64encode(payload).decode(), "topic": topic, "at_ms": 1_700_000_000_000}


def queued(*bodies: Any) -> dict[str, Any]:
    return {"Records": [{"messageId": f"m{number}", "body": body} for number, body in enumerate(bodies)]}


async def unavailable(*_: Any) -> None:
    raise StoreError("the store is unavailable")


def without_store(cloud: Cloud) -> Any:
    """Functions whose presence service cannot read the tables."""
    functions = copy(cloud.functions)
    functions.presence = copy(functions.presence)
    functions.presence._tables = SimpleNamespace(get=unavailable)
    return functions


class TestEventGrid:
    def test_a_payload_declared_as_json_is_stored(self, cloud: Cloud, robot: Robot) -> None:
        event = cloud_event(robot.topic("state"), b"", data=json.loads(state(6)))
        del event["data_base64"]
        cloud.run(cloud_events.from_event_grid(cloud.functions, [event]))
        assert tick(cloud, robot) == 6

    def test_invalid_events_are_dropped_and_valid_ones_stored(
        self, cloud: Cloud, robot: Robot, caplog: pytest.LogCaptureFixture
    ) -> None:
        topic = robot.topic("state")
        batch = [
            cloud_event(topic, state(1), type="Microsoft.Storage.BlobCreated"),
            cloud_event(topic, state(1), data_base64="%%%"),
            cloud_event(topic, state(1), data_base64=None),
            {"type": "MQTT.EventPublished", "subject": topic},
            {"type": "MQTT.EventPublished", "subject": topic, "data": [[[[[[]]]]]]},
            {},
            cloud_event("not/our/topic", state(1)),
            cloud_event(topic, b"{"),
            cloud_event(topic, state(7)),
        ]
        cloud.run(cloud_events.from_event_grid(cloud.functions, batch))
        assert tick(cloud, robot) == 7
        assert len(caplog.records) >= 6

    def test_an_unavailable_store_raises_for_redelivery(self, cloud: Cloud, robot: Robot) -> None:
        batch = [cloud_event(robot.topic("state"), state(8))] * 2
        with pytest.raises(StoreError):
            cloud.run(cloud_events.from_event_grid(without_store(cloud), batch))


class TestIotRule:
    @pytest.mark.parametrize(
        "event", [{}, {"topic": 1, "payload": "e30="}, {"topic": "x"}, {"topic": "x", "payload": "\u00e4"}]
    )
    def test_invalid_events_are_dropped(self, cloud: Cloud, event: dict[str, Any]) -> None:
        cloud.run(cloud_events.from_iot_rule(without_store(cloud), event))

    def test_a_message_is_stored_or_raises_for_redelivery(self, cloud: Cloud, robot: Robot) -> None:
        cloud.run(cloud_events.from_iot_rule(cloud.functions, rule_event(robot.topic("state"), state(9))))
        assert tick(cloud, robot) == 9
        with pytest.raises(StoreError):
            cloud.run(cloud_events.from_iot_rule(without_store(cloud), rule_event(robot.topic("state"), state(1))))


class TestQueue:
    def test_messages_are_stored(self, cloud: Cloud, robot: Robot) -> None:
        bodies = [json.dumps(rule_event(robot.topic("state"), state(number))) for number in (10, 11)]
        response = cloud.run(cloud_events.from_queue(cloud.functions, queued("{", "[]", None, *bodies)))
        assert response == {"batchItemFailures": []}
        assert tick(cloud, robot) == 11

    def test_only_messages_that_were_not_stored_stay_in_the_queue(self, cloud: Cloud, robot: Robot) -> None:
        bodies = ["{", json.dumps(rule_event(robot.topic("state"), state(1))), json.dumps({"topic": "x"})]
        response = cloud.run(cloud_events.from_queue(without_store(cloud), queued(*bodies)))
        assert response == {"batchItemFailures": [{"itemIdentifier": "m1"}]}


class TestConfirmations:
    @pytest.fixture
    def confirmed(self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, bytes]]:
        """The confirmed messages."""
        messages: list[tuple[str, bytes]] = []

        async def publish(stored: Any) -> None:
            messages.extend(stored)

        monkeypatch.setattr(cloud.functions.confirmations, "publish", publish)
        return messages

    @pytest.mark.parametrize("source", ["grid", "rule", "queue"])
    @pytest.mark.parametrize("stored", [True, False])
    def test_stored_and_invalid_messages_are_confirmed(
        self, cloud: Cloud, robot: Robot, confirmed: list[tuple[str, bytes]], source: str, stored: bool
    ) -> None:
        functions = cloud.functions if stored else without_store(cloud)
        event, invalid = codec.encode(EVENT), b"{"
        late = topics.device(robot.space, robot.id, "arm", topics.LATE, "joints")
        messages = [(robot.topic("event"), event), (robot.topic("ack"), invalid), (late, invalid)]
        with contextlib.suppress(StoreError):
            if source == "grid":
                cloud.run(cloud_events.from_event_grid(functions, [cloud_event(*each) for each in messages]))
            elif source == "queue":
                bodies = [json.dumps(rule_event(*each)) for each in messages]
                cloud.run(cloud_events.from_queue(functions, queued(*bodies)))
            else:
                for each in reversed(messages):
                    cloud.run(cloud_events.from_iot_rule(functions, rule_event(*each)))
        assert sorted(confirmed) == sorted(messages if stored else messages[1:])


class TestTelemetry:
    @pytest.fixture
    def batches(self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> list[int]:
        """Number of samples in each write to a series."""
        writer, sizes = cloud.functions.telemetry_ingest._writer, list[int]()
        add = writer.add

        async def counted(place: Any, samples: Any) -> Any:
            sizes.append(len(samples))
            return await add(place, samples)

        monkeypatch.setattr(writer, "add", counted)
        return sizes

    @staticmethod
    def telemetry(cloud: Cloud, robot: Robot) -> list[tuple[str, bytes]]:
        """Twenty measurements and one invalid message."""
        topic = topics.device(robot.space, robot.id, "arm", topics.TELE, "health")
        now_ms = cloud.clock.now_ms()
        bodies = [
            codec.encode(Measurements(tick_ms=1, at_ms=now_ms - 10 * n, sequence=n, values={"a": 1.0}))
            for n in range(20)
        ]
        return [(topic, body) for body in (*bodies, b"{")]

    def test_telemetry_of_event_grid_is_stored_in_one_batch(
        self, cloud: Cloud, robot: Robot, batches: list[int]
    ) -> None:
        events = [cloud_event(*each) for each in self.telemetry(cloud, robot)]
        cloud.run(cloud_events.from_event_grid(cloud.functions, events))
        assert batches == [20]

    def test_telemetry_of_a_queue_is_stored_in_one_batch(self, cloud: Cloud, robot: Robot, batches: list[int]) -> None:
        bodies = [json.dumps(rule_event(*each)) for each in self.telemetry(cloud, robot)]
        for _ in range(2):
            assert cloud.run(cloud_events.from_queue(cloud.functions, queued(*bodies))) == {"batchItemFailures": []}
        assert batches == [20, 20]
        (stream,) = cloud.sign_in("anna").get(f"/devices/{robot.device}/data").json()["items"]
        assert stream["samples"] == 20

    def test_telemetry_that_was_not_stored_is_delivered_again(
        self, cloud: Cloud, robot: Robot, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        messages = self.telemetry(cloud, robot)
        monkeypatch.setattr(cloud.functions.tables, "create", unavailable)
        with pytest.raises(StoreError):
            cloud.run(cloud_events.from_event_grid(cloud.functions, [cloud_event(*each) for each in messages]))
        records = queued(*(json.dumps(rule_event(*each)) for each in messages))
        response = cloud.run(cloud_events.from_queue(cloud.functions, records))
        assert len(response["batchItemFailures"]) == len(messages)
