"""Live measurements, from the broker to the API."""

from typing import Any

from device_agent.protocol import Description, Joint, JointTelemetry, Measurements, Mode, codec, topics
from function_app.services.storage import records
from function_app.services.telemetry.series_writer import Place
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.network.brokers import wait_until


def measure(robot: Robot, stream: str, at_ms: int, **values: float) -> None:
    body: Any = Measurements(tick_ms=at_ms, at_ms=at_ms, sequence=1, values=dict(values))
    if stream == topics.JOINTS:
        body = JointTelemetry(
            tick_ms=at_ms, at_ms=at_ms, sequence=1, mode=Mode.IDLE, position_rad=tuple(values.values()),
            velocity_rad_s=(), effort_nm=(), commanded_rad=(),
        )  # fmt: skip
    assert robot.link is not None
    topic = topics.device(robot.space, robot.id, "arm", topics.TELE, stream)
    robot.link.publish(topic, codec.encode(body), qos=0)


def streams(anna: Person, robot: Robot) -> dict[str, Any]:
    answer = anna.get(f"/devices/{robot.device}/data")
    assert answer.status_code == 200, answer.text
    return {stream["name"]: stream for stream in answer.json()["items"]}


def test_published_measurements_can_be_read(cloud: Cloud, anna: Person, robot: Robot) -> None:
    limits: Any = dict.fromkeys(("upper_rad", "max_velocity_rad_s", "max_acceleration_rad_s2", "max_effort_nm"), 1.0)
    arm = [Joint(name=name, label="", lower_rad=0.0, max_jerk_rad_s3=1.0, **limits) for name in ("a", "b")]
    description = Description(device="arm", kind="arm", robot_type="ur5", label="Arm", joints=tuple(arm))
    robot.publish(robot.topic(topics.DESC), description, retain=True)
    described = (records.DESCRIPTIONS, robot.id, "arm")
    wait_until(lambda: cloud.run(cloud.functions.tables.get(*described)), "the description to be stored")
    cloud.start_telemetry()
    begin_ms = cloud.clock.now_ms() - 60_000
    for number in range(100):
        measure(robot, "health", begin_ms + 200 * number, temperature_c=40.0 + number)
        measure(robot, "joints", begin_ms + 200 * number, a=number / 10, b=-1.0)
    wait_until(lambda: {each["samples"] for each in streams(anna, robot).values()} == {100}, "all samples to be stored")
    found = streams(anna, robot)
    assert found["health"]["fields"] == ["temperature_c"]
    assert found["joints"]["fields"] == ["position_rad.a", "position_rad.b"]

    raw = anna.get(f"/devices/{robot.device}/data/health").json()
    assert (raw["resolution"], raw["span_ms"], raw["cursor"]) == ("raw", 0, None)
    assert raw["at_ms"] == [begin_ms + 200 * number for number in range(100)]
    assert raw["fields"]["temperature_c"]["mean"] == [40.0 + number for number in range(100)]

    query = {"resolution": "1h", "fields": "position_rad.a", "from": begin_ms, "to": begin_ms + 20_000}
    hours = anna.get(f"/devices/{robot.device}/data/joints", params=query).json()
    column = hours["fields"].pop("position_rad.a")
    assert hours["fields"] == {}
    assert sum(column["count"]) == 100
    assert (min(column["min"]), max(column["max"]), column["last"][-1]) == (0.0, 9.9, 9.9)


def test_invalid_queries_are_refused(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    cloud.start_telemetry()
    anna, robot = pair
    measure(robot, "health", cloud.clock.now_ms(), a=1.0)
    wait_until(lambda: streams(anna, robot), "the sample to be stored")
    path = f"/devices/{robot.device}/data/health"
    for query, code in (
        ({"points": 0}, "invalid"),
        ({"points": 1001}, "invalid"),
        ({"from": -1}, "invalid"),
        ({"to": 10**13}, "invalid"),
        ({"from": "yesterday"}, "invalid"),
        ({"resolution": "2h"}, "invalid"),
        ({"fields": "b"}, "field-unknown"),
        ({"fields": ""}, "field-unknown"),
        ({"cursor": "raw.x"}, "cursor-invalid"),
        ({"cursor": "2h.0"}, "cursor-invalid"),
    ):
        problem(anna.get(path, params=query), 422, code)
    problem(anna.get(f"/devices/{robot.device}/data/other"), 404, "stream-unknown")
    empty = anna.get(path, params={"from": 9_999_999_999_999}).json()
    assert (empty["at_ms"], empty["cursor"]) == ([], None)
    assert anna.get(path, params={"from": 2000, "to": 1000}).json()["at_ms"] == []


def test_measurements_of_an_unpaired_robot_are_deleted(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    cloud.start_telemetry()
    anna, robot = pair
    for stream in ("health", "power"):
        measure(robot, stream, cloud.clock.now_ms(), a=1.0)
    wait_until(lambda: len(streams(anna, robot)) == 2, "the samples to be stored")
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    place = Place(robot.device, row.data["pairing"], "health")
    assert anna.delete(f"/agents/{robot.id}").status_code == 204

    def left() -> int:
        places = (place.streams, place.partition, place._replace(stream="power").partition)
        pages = [cloud.run(cloud.functions.tables.query(records.SERIES, each)) for each in places]
        return sum(len(page.rows) for page in pages)

    assert left() == 2 + 2 * 8
    cloud.sweep()
    assert left() == 2 + 2 * 8
    cloud.clock.advance(2 * 3600)
    cloud.sweep()
    assert left() == 0
