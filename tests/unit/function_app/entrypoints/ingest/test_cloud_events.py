"""What the clouds hand over reaches the tables as what a broker says does; what cannot be stored is refused."""

import base64
import json
from copy import copy
from types import SimpleNamespace
from typing import Any

import pytest

from device_agent.protocol import Measurements, Mode, State, codec, topics
from function_app.entrypoints.ingest import cloud_events
from function_app.ports.tables import StoreError
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud


def state(tick_ms: int) -> bytes:
    return codec.encode(State(device="arm", at_ms=1, tick_ms=tick_ms, mode=Mode.IDLE, epoch=0))


def tick(cloud: Cloud, robot: Robot) -> int | None:
    """Of the state that the API shows."""
    shown = cloud.sign_in("anna").get(f"/devices/{robot.device}").json()["state"]
    return None if shown is None else int(shown["tick_ms"])


def cloud_event(topic: str, payload: bytes, **changes: Any) -> dict[str, Any]:
    """As the namespace routes a message without a content type."""
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


async def away(*_: Any) -> None:
    raise StoreError("the store is away")


def without_store(cloud: Cloud) -> Any:
    """The functions, whose presence cannot read the tables."""
    functions = copy(cloud.functions)
    functions.presence = copy(functions.presence)
    functions.presence._tables = SimpleNamespace(get=away)
    return functions


class TestEventGrid:
    def test_also_when_its_publisher_called_it_json(self, cloud: Cloud, robot: Robot) -> None:
        event = cloud_event(robot.topic("state"), b"", data=json.loads(state(6)))
        del event["data_base64"]
        cloud.run(cloud_events.from_event_grid(cloud.functions, [event]))
        assert tick(cloud, robot) == 6

    def test_what_cannot_be_read_is_let_go_and_the_others_go_on(
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
            cloud_event("no/topic/of/ours", state(1)),
            cloud_event(topic, b"{"),
            cloud_event(topic, state(7)),
        ]
        cloud.run(cloud_events.from_event_grid(cloud.functions, batch))
        assert tick(cloud, robot) == 7
        assert len(caplog.records) >= 6

    def test_a_store_that_is_away_makes_the_cloud_deliver_again(self, cloud: Cloud, robot: Robot) -> None:
        batch = [cloud_event(robot.topic("state"), state(8))] * 2
        with pytest.raises(StoreError):
            cloud.run(cloud_events.from_event_grid(without_store(cloud), batch))


class TestIotRule:
    @pytest.mark.parametrize(
        "event", [{}, {"topic": 1, "payload": "e30="}, {"topic": "x"}, {"topic": "x", "payload": "\u00e4"}]
    )
    def test_what_the_rule_does_not_give_is_let_go(self, cloud: Cloud, event: dict[str, Any]) -> None:
        cloud.run(cloud_events.from_iot_rule(without_store(cloud), event))

    def test_a_message_is_stored_and_delivered_again_while_the_store_is_away(self, cloud: Cloud, robot: Robot) -> None:
        cloud.run(cloud_events.from_iot_rule(cloud.functions, rule_event(robot.topic("state"), state(9))))
        assert tick(cloud, robot) == 9
        with pytest.raises(StoreError):
            cloud.run(cloud_events.from_iot_rule(without_store(cloud), rule_event(robot.topic("state"), state(1))))


class TestQueue:
    def test_messages_reach_the_tables(self, cloud: Cloud, robot: Robot) -> None:
        bodies = [json.dumps(rule_event(robot.topic("state"), state(number))) for number in (10, 11)]
        answer = cloud.run(cloud_events.from_queue(cloud.functions, queued("{", "[]", None, *bodies)))
        assert answer == {"batchItemFailures": []}
        assert tick(cloud, robot) == 11

    def test_what_was_not_stored_and_only_that_stays_in_the_queue(self, cloud: Cloud, robot: Robot) -> None:
        bodies = ["{", json.dumps(rule_event(robot.topic("state"), state(1))), json.dumps({"topic": "x"})]
        answer = cloud.run(cloud_events.from_queue(without_store(cloud), queued(*bodies)))
        assert answer == {"batchItemFailures": [{"itemIdentifier": "m1"}]}


class TestTelemetry:
    @pytest.fixture
    def batches(self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> list[int]:
        """How many samples each write into a series had."""
        writer, sizes = cloud.functions.telemetry_ingest._writer, list[int]()
        add = writer.add

        async def counted(place: Any, samples: Any) -> Any:
            sizes.append(len(samples))
            return await add(place, samples)

        monkeypatch.setattr(writer, "add", counted)
        return sizes

    @staticmethod
    def measured(cloud: Cloud, robot: Robot) -> list[tuple[str, bytes]]:
        """Twenty measurements and one that is none."""
        topic = topics.device(robot.space, robot.id, "arm", topics.TELE, "health")
        now_ms = cloud.clock.now_ms()
        bodies = [
            codec.encode(Measurements(tick_ms=1, at_ms=now_ms - 10 * n, sequence=n, values={"a": 1.0}))
            for n in range(20)
        ]
        return [(topic, body) for body in (*bodies, b"{")]

    def test_event_grids_measurements_are_taken_in_together(
        self, cloud: Cloud, robot: Robot, batches: list[int]
    ) -> None:
        events = [cloud_event(*each) for each in self.measured(cloud, robot)]
        cloud.run(cloud_events.from_event_grid(cloud.functions, events))
        assert batches == [20]

    def test_a_queues_measurements_are_taken_in_together(self, cloud: Cloud, robot: Robot, batches: list[int]) -> None:
        bodies = [json.dumps(rule_event(*each)) for each in self.measured(cloud, robot)]
        for _ in range(2):
            assert cloud.run(cloud_events.from_queue(cloud.functions, queued(*bodies))) == {"batchItemFailures": []}
        assert batches == [20, 20]
        (stream,) = cloud.sign_in("anna").get(f"/devices/{robot.device}/data").json()["items"]
        assert stream["samples"] == 20

    def test_what_was_not_stored_is_delivered_again(
        self, cloud: Cloud, robot: Robot, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        messages = self.measured(cloud, robot)
        monkeypatch.setattr(cloud.functions.tables, "create", away)
        with pytest.raises(StoreError):
            cloud.run(cloud_events.from_event_grid(cloud.functions, [cloud_event(*each) for each in messages]))
        records = queued(*(json.dumps(rule_event(*each)) for each in messages))
        answer = cloud.run(cloud_events.from_queue(cloud.functions, records))
        assert len(answer["batchItemFailures"]) == len(messages)
