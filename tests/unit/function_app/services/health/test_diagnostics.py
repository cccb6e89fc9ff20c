"""Measurements are monitored as they arrive; faults are raised, acknowledged and cleared."""

import random
from collections.abc import Callable, Iterable
from typing import Any

import pytest

from device_agent.protocol import Description, Joint, JointTelemetry, Measurements, Mode, State, codec, topics
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired, problem

Temperature = Callable[[int], float]
MINUTE = 6
"""Windows."""


class MeasuringRobot:
    """A robot that measures every ten seconds of simulated time."""

    def __init__(self, cloud: Cloud, robot: Robot, *, stream: str = "health", seed: int = 0) -> None:
        self.cloud = cloud
        self.robot = robot
        self.topic = topics.device(robot.space, robot.id, robot.names[0], topics.TELE, stream)
        self.windows = 0
        self.now_ms = cloud.clock.now_ms()
        self._chance = random.Random(seed)  # noqa: S311 (repeatable noise)

    def messages(self, windows: int, **truth: Temperature) -> Iterable[tuple[str, bytes]]:
        """The measurements of ``windows`` windows; each function maps the window number to a value."""
        for number in range(windows):
            self.cloud.clock.advance(10)
            self.now_ms += 10_000
            values: dict[str, float | bool] = {
                name.replace("__", "."): value(number) + self._chance.gauss(0, 0.2) for name, value in truth.items()
            }
            self.windows += 1
            message = Measurements(tick_ms=self.now_ms, at_ms=self.now_ms, sequence=self.windows, values=values)
            yield self.topic, codec.encode(message)

    def live(self, windows: int, **truth: Temperature) -> None:
        """Ingest the measurements of ``windows`` windows."""
        batch = list(self.messages(windows, **truth))
        self.cloud.run(ingest_telemetry(self.cloud.functions, batch))


def still(level: float) -> Temperature:
    return lambda _: level


def warming(level: float, per_minute: float) -> Temperature:
    return lambda number: level + per_minute * number / MINUTE


def health(cloud: Cloud, person: Person, robot: Robot) -> str:
    """Publish a state; return the health of the robot."""
    now_ms = cloud.clock.now_ms()
    state = State(device="arm", at_ms=now_ms, tick_ms=now_ms, mode=Mode.IDLE, epoch=0)
    cloud.run(ingest(cloud.functions, robot.topic(topics.STATE), codec.encode(state)))
    return str(diagnostics(person, robot)["health"])


def diagnostics(person: Person, robot: Robot) -> dict[str, Any]:
    answer = person.get(f"/devices/{robot.device}/diagnostics")
    assert answer.status_code == 200, answer.text
    return answer.json()  # type: ignore[no-any-return]


def partition(cloud: Cloud, robot: Robot) -> str:
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    return f"{robot.device}/{row.data['pairing']}"


def field(person: Person, robot: Robot, name: str) -> dict[str, Any]:
    return next(item for item in diagnostics(person, robot)["fields"] if item["field"] == name)


def open_faults(person: Person, robot: Robot) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = person.get(f"/devices/{robot.device}/faults", params={"open": True}).json()["items"]
    return items


def test_a_warming_joint_is_reported_before_its_limit(cloud: Cloud, anna: Person, robot: Robot) -> None:
    cloud.start_telemetry()
    life = MeasuringRobot(cloud, robot)

    def publish(windows: int, elbow: Temperature) -> None:
        assert robot.link is not None
        for topic, payload in life.messages(windows, temperature_c__elbow=elbow, temperature_c__wrist_1=still(30)):
            robot.link.publish_acknowledged(topic, payload)

    publish(12 * MINUTE, still(35))
    assert health(cloud, anna, robot) == "ok"
    at_c = 35.0
    while not open_faults(anna, robot):
        publish(5 * MINUTE, warming(at_c, 0.5))
        at_c += 2.5
        assert at_c < 65, "at least half an hour before the limit"
    (fault,) = open_faults(anna, robot)
    expected = {"code": "health.temperature_c.elbow", "kind": "trend", "severity": "warning", "limit": 80.0}
    assert fault.items() >= expected.items()
    assert 50 < fault["value"] < 65
    assert fault["message"].startswith("Joint temperature (elbow) is ")
    assert "rises by 0." in fault["message"]
    assert fault["message"].endswith("Let the arm rest or work more slowly, and see that air reaches the joint.")
    shown = field(anna, robot, "temperature_c.elbow")
    assert shown["findings"] == ["trend"]
    assert shown["slope_per_s"] == pytest.approx(0.5 / 60, rel=0.2)
    while shown["limit_latest_s"] is None:
        publish(MINUTE, warming(at_c, 0.5))
        at_c += 0.5
        assert at_c < 70, "a forecast before the warning limit"
        shown = field(anna, robot, "temperature_c.elbow")
    remaining_s = (80 - at_c) / 0.5 * 60
    assert shown["limit_earliest_s"] < remaining_s < shown["limit_latest_s"]
    assert shown["limit_latest_s"] <= 4 * shown["limit_earliest_s"], "the widest interval that is published"
    assert field(anna, robot, "temperature_c.wrist_1")["findings"] == []
    assert health(cloud, anna, robot) == "warning"
    assert anna.post(f"/devices/{robot.device}/faults/{fault['id']}/acknowledge").json()["state"] == "acknowledged"
    publish(20 * MINUTE, still(40))
    assert open_faults(anna, robot) == []
    assert health(cloud, anna, robot) == "ok"
    (past,) = anna.get(f"/devices/{robot.device}/faults").json()["items"]
    assert (past["id"], past["state"], past["acknowledged_by"]) == (fault["id"], "cleared", "anna")
    events = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert [event["kind"] for event in events] == ["fault-cleared", "fault-acknowledged", "fault-raised"]


def test_measurements_over_http_are_monitored(cloud: Cloud) -> None:
    anna = cloud.sign_in("anna")
    with cloud.robot() as robot:
        code = robot.enroll(transport="http").json()["claim_code"]
        anna.post("/agents/claim", {"code": code})
        robot.space = robot.enrollment()["space"]
        life = MeasuringRobot(cloud, robot)
        for _ in range(2):
            measured = life.messages(5, temperature_c__elbow=still(84))
            messages = [{"topic": topic, "payload": codec.decode(payload, dict)} for topic, payload in measured]
            answer = robot.request("POST", f"/agents/{robot.id}/messages", json={"messages": messages})
            assert answer.status_code == 200, answer.text
        (fault,) = open_faults(anna, robot)
        assert (fault["kind"], fault["severity"], fault["limit"]) == ("level", "error", 80.0)
        assert health(cloud, anna, robot) == "fault"


def test_a_warning_becomes_an_error_beyond_the_limit_within_a_minute(cloud: Cloud, anna: Person, robot: Robot) -> None:
    life = MeasuringRobot(cloud, robot)
    life.now_ms = life.now_ms // 60_000 * 60_000 - 10_000
    life.live(3, temperature_c__elbow=still(74))
    (warning,) = open_faults(anna, robot)
    assert (warning["kind"], warning["severity"], warning["limit"]) == ("level", "warning", 70.0)
    life.live(3, temperature_c__elbow=still(90))
    assert life.now_ms % 60_000 == 50_000, "all in one minute"
    (fault,) = open_faults(anna, robot)
    assert (fault["id"], fault["severity"], fault["limit"], fault["worsened"]) == (warning["id"], "error", 80.0, 1)
    life.live(10, temperature_c__elbow=still(45))
    assert open_faults(anna, robot) == []


def test_a_change_of_a_value_without_limits_is_an_info(cloud: Cloud, anna: Person, robot: Robot) -> None:
    life = MeasuringRobot(cloud, robot)
    life.live(20 * MINUTE, fan_hz=still(50), door=still(0))
    assert open_faults(anna, robot) == []
    life.live(2 * MINUTE, fan_hz=still(20), door=still(0))
    (fault,) = open_faults(anna, robot)
    assert (fault["code"], fault["severity"], fault["baseline"]) == ("health.fan_hz", "info", pytest.approx(50, abs=1))
    assert health(cloud, anna, robot) == "ok"
    shown = field(anna, robot, "fan_hz")
    assert shown["usual_low"] > 20
    assert (shown["high"], shown["low"], shown["advice"]) == (None, None, "")


def test_effort_is_monitored_and_positions_are_not(cloud: Cloud, anna: Person, robot: Robot) -> None:
    joint = Joint(
        name="elbow", label="Elbow", lower_rad=-1, upper_rad=1, max_velocity_rad_s=1, max_acceleration_rad_s2=1,
        max_jerk_rad_s3=1, max_effort_nm=150,
    )  # fmt: skip
    robot.publish(
        robot.topic(topics.DESC),
        Description(device="arm", kind="arm", robot_type="ur5", label="Arm", joints=(joint,)),
        retain=True,
    )

    def joints(effort_nm: float) -> Iterable[tuple[str, bytes]]:
        for _ in range(6):
            cloud.clock.advance(10)
            now_ms = cloud.clock.now_ms()
            telemetry = JointTelemetry(
                tick_ms=now_ms,
                at_ms=now_ms,
                sequence=now_ms,
                mode=Mode.IDLE,
                position_rad=(1.0,),
                velocity_rad_s=(0.0,),
                effort_nm=(effort_nm,),
                commanded_rad=(1.0,),
            )
            yield topics.device(robot.space, robot.id, "arm", topics.TELE, topics.JOINTS), codec.encode(telemetry)

    cloud.run(ingest_telemetry(cloud.functions, list(joints(-40.0))))
    assert [item["field"] for item in diagnostics(anna, robot)["fields"]] == ["effort_nm.elbow"]
    cloud.run(ingest_telemetry(cloud.functions, list(joints(-130.0))))
    (fault,) = open_faults(anna, robot)
    assert (fault["kind"], fault["limit"], fault["stream"]) == ("level", -120.0, "joints")


def test_devices_are_listed_worst_first_with_counts(cloud: Cloud) -> None:
    with paired(cloud, "anna", "arm", "leg") as (anna, robot):
        life = MeasuringRobot(cloud, robot)
        life.live(4, temperature_c__elbow=still(90))
        other = cloud.robot("hand")
        other.pair(anna)
        listed = anna.get("/diagnostics").json()
        assert [item["device"] for item in listed["items"]] == [robot.devices[0], other.device, robot.devices[1]]
        assert [item["health"] for item in listed["items"]] == ["fault", "unknown", "ok"]
        assert listed["counts"] == {"fault": 1, "warning": 0, "unknown": 1, "ok": 1}
        assert listed["items"][0]["worst"]["severity"] == "error"
        assert listed["items"][0]["counts"] == {"error": 1, "warning": 0, "info": 0}
        assert anna.get(f"/spaces/{robot.space}/diagnostics").json() == listed
        devices = [item["device"] for item in anna.pages("/diagnostics", limit=1)]
        assert sorted(devices) == sorted(item["device"] for item in listed["items"])
        bert = cloud.sign_in("bert")
        assert bert.get("/diagnostics").json()["items"] == []
        problem(bert.get(f"/spaces/{robot.space}/diagnostics"), 404, "space-unknown")
        problem(bert.get(f"/devices/{robot.device}/diagnostics"), 404, "device-unknown")
        problem(anna.get("/diagnostics", params={"cursor": "x"}), 422, "cursor-invalid")


def test_concurrent_workers_lose_no_window(open_cloud: Any, cloud: Cloud, anna: Person, robot: Robot) -> None:
    clouds = [cloud, open_cloud(clock=cloud.clock), open_cloud(clock=cloud.clock)]
    batch = list(
        MeasuringRobot(cloud, robot).messages(12, temperature_c__elbow=still(90), temperature_c__wrist_1=still(30))
    )
    calls = [one.begin(ingest_telemetry(one.functions, batch)) for one in clouds for _ in "ab"]
    for finish in calls:
        finish()
    assert [fault["code"] for fault in open_faults(anna, robot)] == ["health.temperature_c.elbow"]
    assert diagnostics(anna, robot)["fields"][0]["value"] == pytest.approx(90, abs=1)


def test_a_state_lost_by_a_killed_worker_is_corrected(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    life = MeasuringRobot(cloud, robot)
    life.live(2, temperature_c__elbow=still(40))
    real = cloud.functions.tables.replace

    async def dying(table: str, row: Any) -> Any:
        if table == records.DIAGNOSTICS:
            raise RuntimeError("killed")
        return await real(table, row)

    monkeypatch.setattr(cloud.functions.tables, "replace", dying)
    life.live(4, temperature_c__elbow=still(90))
    assert len(open_faults(anna, robot)) == 1, "the fault is stored, but the state of its detector is not"
    monkeypatch.undo()
    life.live(8, temperature_c__elbow=still(40))
    assert open_faults(anna, robot) == []


def test_an_unknown_robot_type_with_a_hundred_fields_is_monitored_without_limits(cloud: Cloud) -> None:
    anna = cloud.sign_in("anna")
    with cloud.robot() as robot:
        devices = [{"name": "arm", "kind": "arm", "robot_type": "unknown-type", "label": "Arm"}]
        code = robot.enroll(devices=devices).json()["claim_code"]
        anna.post("/agents/claim", {"code": code})
        robot.space = robot.enrollment()["space"]
        many: dict[str, Temperature] = {f"value_{number:03d}": still(float(number)) for number in range(120)}
        life = MeasuringRobot(cloud, robot)
        life.live(130, **many)
        fields = diagnostics(anna, robot)["fields"]
        assert [item["field"] for item in fields] == sorted(many)[:100]
        row = cloud.run(cloud.functions.tables.get(records.DIAGNOSTICS, partition(cloud, robot), "health"))
        assert row is not None
        assert len(codec.encode(row.data)) < 200_000


def test_data_of_an_earlier_pairing_are_hidden_and_deleted(cloud: Cloud, anna: Person, robot: Robot) -> None:
    MeasuringRobot(cloud, robot).live(4, temperature_c__elbow=still(90))
    sample = {"at_ms": cloud.clock.now_ms(), "ms": 5.0}
    latency = {"transport": "mqtt", "path": "operator-device", "samples": [sample]}
    assert anna.post(f"/devices/{robot.device}/latency", latency).status_code == 204
    former = partition(cloud, robot)

    def left() -> set[str]:
        tables = (records.FAULTS, records.DIAGNOSTICS, records.LATENCY)
        pages = {table: cloud.run(cloud.functions.tables.query(table, former)) for table in tables}
        # Rows that count a code contain their own expiry.
        return {table for table, page in pages.items() if any("expires_ms" not in row.data for row in page.rows)}

    assert left() == {records.FAULTS, records.DIAGNOSTICS, records.LATENCY}
    anna.delete(f"/agents/{robot.id}")
    bert = cloud.sign_in("bert")
    robot.pair(bert)
    assert (diagnostics(bert, robot)["fields"], diagnostics(bert, robot)["faults"]) == ([], [])
    cloud.clock.advance(2 * 3600)
    cloud.sweep()
    assert left() == set()
