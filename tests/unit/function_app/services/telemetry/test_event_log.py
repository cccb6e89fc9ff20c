"""Events of a device are listed in pages, to authorized accounts only."""

from typing import Any

from device_agent.protocol import Event, Measurements, codec, topics
from device_agent.protocol.events import EventKind
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem

Pair = tuple[Person, Robot]


def ingest_event(cloud: Cloud, robot: Robot, number: int, **changes: Any) -> None:
    fields: dict[str, Any] = {
        "id": f"e{number}",
        "device": "arm",
        "at_ms": 1_700_000_000_000 + number,
        "kind": EventKind.COMMAND_REJECTED,
        "severity": "warning",
        "message": "a command was refused",
        "data": {"code": "expired", "epoch": number},
    }
    payload = codec.encode(Event(**(fields | changes)))
    cloud.run(ingest(cloud.functions, robot.topic(topics.EVENT), payload))


def test_events_are_listed_newest_first_with_both_times(cloud: Cloud, anna: Person, robot: Robot) -> None:
    for number in (2, 0, 3, 1, 4, 4):
        ingest_event(cloud, robot, number)
    pages = anna.each_page(f"/devices/{robot.device}/events", limit=2)
    assert max(map(len, pages)) <= 2
    shown = [event for page in pages for event in page]
    assert [event["id"] for event in shown] == ["e4", "e3", "e2", "e1", "e0"]
    newest = shown[0]
    assert newest["data"] == {"code": "expired", "epoch": 4}
    assert (newest["kind"], newest["severity"]) == ("command-rejected", "warning")
    assert newest["at"] < newest["received_at"]
    problem(anna.get(f"/devices/{robot.device}/events", params={"cursor": "%%%"}), 422, "cursor-invalid")


def test_a_later_owner_reads_no_earlier_data(cloud: Cloud, anna: Person, robot: Robot) -> None:
    cloud.start_telemetry()
    at, now_ms = f"/devices/{robot.device}", cloud.clock.now_ms()
    ingest_event(cloud, robot, 1)
    latency = {"transport": "mqtt", "path": "operator-device", "samples": [{"at_ms": now_ms, "ms": 5.0}]}
    assert anna.post(f"{at}/latency", latency).status_code == 204
    measured = codec.encode(Measurements(tick_ms=1, at_ms=now_ms, sequence=1, values={"a": 1.0}))
    cloud.run(ingest_telemetry(cloud.functions, [(f"{robot.topic(topics.TELE)}/health", measured)]))
    lists = [f"{at}/{name}" for name in ("events", "latency", "data")]
    assert all(anna.get(path).json()["items"] for path in lists)
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    bert = cloud.sign_in("bert")
    robot.pair(bert)
    assert [bert.get(path).json()["items"] for path in lists] == [[], [], []]
    problem(bert.get(f"{at}/data/health"), 404, "stream-unknown")
    ingest_event(cloud, robot, 2)
    assert [event["id"] for event in bert.get(f"{at}/events").json()["items"]] == ["e2"]


def test_an_event_with_an_invalid_time_is_dropped(cloud: Cloud, anna: Person, robot: Robot) -> None:
    ingest_event(cloud, robot, 1, at_ms=2**52)
    assert anna.get(f"/devices/{robot.device}/events").json()["items"] == []
