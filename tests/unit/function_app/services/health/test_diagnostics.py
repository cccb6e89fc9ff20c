"""Telediagnostics: what robots measure is judged while it comes in; faults are raised, seen, cleared, remembered."""

import random
from collections.abc import Callable, Iterable
from typing import Any

import pytest

from device_agent.protocol import JointTelemetry, Measurements, Mode, State, codec, topics
from function_app.adapters.local import device_feed
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]
Temperature = Callable[[int], float]
MINUTE = 6
"""Windows."""


class Life:
    """A robot that measures every ten seconds of its own, faster time."""

    def __init__(self, cloud: Cloud, robot: Robot, *, stream: str = "health", seed: int = 0) -> None:
        self.cloud = cloud
        self.robot = robot
        self.topic = topics.device(robot.space, robot.id, robot.names[0], topics.TELE, stream)
        self.windows = 0
        self.now_ms = cloud.clock.now_ms()
        """The robot's own clock: how long a test takes is nothing to it."""
        self._chance = random.Random(seed)  # noqa: S311 (repeatable noise)

    def messages(self, windows: int, **truth: Temperature) -> Iterable[tuple[str, bytes]]:
        """The measurements of so many windows; each truth is given the window's number."""
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
        """As if the broker had delivered them."""
        batch = list(self.messages(windows, **truth))
        self.cloud.run(ingest_telemetry(self.cloud.functions, batch))


def still(level: float) -> Temperature:
    return lambda _: level


def warming(level: float, per_minute: float) -> Temperature:
    return lambda number: level + per_minute * number / MINUTE


def health(cloud: Cloud, who: Person, robot: Robot) -> str:
    """Of a robot that is there: its clock has run ahead of its last word."""
    now_ms = cloud.clock.now_ms()
    state = State(device="arm", at_ms=now_ms, tick_ms=now_ms, mode=Mode.IDLE, epoch=0)
    cloud.run(ingest(cloud.functions, robot.topic(topics.STATE), codec.encode(state)))
    found: str = diagnostics(who, robot)["health"]
    return found


def diagnostics(who: Person, robot: Robot) -> dict[str, Any]:
    answer = who.get(f"/devices/{robot.device}/diagnostics")
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def field(who: Person, robot: Robot, name: str) -> dict[str, Any]:
    return next(item for item in diagnostics(who, robot)["fields"] if item["field"] == name)


def open_faults(who: Person, robot: Robot) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = who.get(f"/devices/{robot.device}/faults", params={"open": True}).json()["items"]
    return items


def test_a_joint_that_heats_up_is_told_before_its_limit_over_the_broker(
    cloud: Cloud, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_feed, "COLLECT_S", 0.1)
    cloud.start_telemetry()
    anna, robot = pair
    life = Life(cloud, robot)

    def publish(windows: int, **truth: Temperature) -> Person:
        """Until it is in the tables; and Anna, whose token has run out since."""
        assert robot.link is not None
        for topic, payload in life.messages(windows, **truth):
            robot.link.publish_acknowledged(topic, payload)
        newest_ms = life.now_ms - 30_000
        wait_until(
            lambda: any(
                row.data["window_ms"] > newest_ms
                for row in cloud.run(cloud.functions.tables.query(records.DIAGNOSTICS, partition)).rows
            ),
            "the newest window",
        )
        return cloud.sign_in("anna")

    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    partition = f"{robot.device}/{row.data['pairing']}"
    anna = publish(12 * MINUTE, temperature_c__elbow=still(35), temperature_c__wrist_1=still(30))
    assert health(cloud, anna, robot) == "ok"
    at_c = 35.0
    while not open_faults(anna, robot):
        anna = publish(5 * MINUTE, temperature_c__elbow=warming(at_c, 0.5), temperature_c__wrist_1=still(30))
        at_c += 2.5
        assert at_c < 65, "half an hour before the limit at the latest"
    (fault,) = open_faults(anna, robot)
    assert (fault["code"], fault["kind"], fault["severity"], fault["limit"]) == (
        "health.temperature_c.elbow",
        "trend",
        "warning",
        80.0,
    )
    assert 50 < fault["value"] < 65
    assert fault["message"].startswith("Joint temperature (elbow) is ")
    assert "rises by 0." in fault["message"]
    assert fault["message"].endswith("Let the arm rest or work more slowly, and see that air reaches the joint.")
    shown = field(anna, robot, "temperature_c.elbow")
    assert shown["findings"] == ["trend"]
    assert shown["slope_per_s"] == pytest.approx(0.5 / 60, rel=0.2)
    assert 1_000 < shown["limit_in_s"] < 2_700
    assert field(anna, robot, "temperature_c.wrist_1")["findings"] == []
    assert health(cloud, anna, robot) == "warning"

    seen = anna.post(f"/devices/{robot.device}/faults/{fault['id']}/acknowledge")
    assert seen.json()["state"] == "acknowledged"
    anna = publish(20 * MINUTE, temperature_c__elbow=still(40), temperature_c__wrist_1=still(30))
    assert open_faults(anna, robot) == []
    assert health(cloud, anna, robot) == "ok"
    (past,) = anna.get(f"/devices/{robot.device}/faults").json()["items"]
    assert (past["id"], past["state"], past["acknowledged_by"]) == (fault["id"], "cleared", "anna")
    page = anna.get(f"/devices/{robot.device}/events").json()
    assert [event["kind"] for event in page["items"]] == ["fault-cleared", "fault-acknowledged", "fault-raised"]


def test_it_is_the_same_for_a_robot_that_speaks_http(cloud: Cloud) -> None:
    anna = cloud.sign_in("anna")
    with cloud.robot() as robot:
        code = robot.enroll(transport="http").json()["claim_code"]
        anna.post("/agents/claim", {"code": code})
        robot.space = robot.enrollment()["space"]
        life = Life(cloud, robot)
        for _ in range(2):
            told = [
                {"topic": topic, "payload": codec.decode(payload, dict)}
                for topic, payload in life.messages(5, temperature_c__elbow=still(84))
            ]
            answer = robot.ask("POST", f"/agents/{robot.id}/messages", json={"messages": told})
            assert answer.status_code == 200, answer.text
        (fault,) = open_faults(anna, robot)
        assert (fault["kind"], fault["severity"], fault["limit"]) == ("level", "error", 80.0)
        assert health(cloud, anna, robot) == "fault"


def test_a_warning_becomes_an_error_beyond_the_limit_and_stays_one_fault(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    life = Life(cloud, robot)
    life.live(4, temperature_c__elbow=still(74))
    (warned,) = open_faults(anna, robot)
    assert (warned["kind"], warned["severity"], warned["limit"]) == ("level", "warning", 70.0)
    life.live(4, temperature_c__elbow=still(83))
    (fault,) = open_faults(anna, robot)
    assert (fault["id"], fault["severity"], fault["limit"], fault["worsened"]) == (warned["id"], "error", 80.0, 1)
    life.live(10, temperature_c__elbow=still(45))
    assert open_faults(anna, robot) == []


def test_what_passes_its_limit_is_told_at_once_and_not_at_the_end_of_the_minute(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    life = Life(cloud, robot)
    life.now_ms = life.now_ms // 60_000 * 60_000 - 10_000
    life.live(3, temperature_c__elbow=still(74))
    life.live(3, temperature_c__elbow=still(90))
    assert life.now_ms % 60_000 == 50_000, "all in one minute"
    assert [fault["severity"] for fault in open_faults(anna, robot)] == ["error"]


def test_a_value_without_limits_is_reported_without_a_warning(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    life = Life(cloud, robot)
    life.live(20 * MINUTE, fan_hz=still(50), door=still(0))
    assert open_faults(anna, robot) == []
    life.live(2 * MINUTE, fan_hz=still(20), door=still(0))
    (fault,) = open_faults(anna, robot)
    assert (fault["code"], fault["severity"], fault["baseline"]) == (
        "health.fan_hz",
        "info",
        pytest.approx(50, abs=1),
    )
    assert health(cloud, anna, robot) == "ok"
    shown = field(anna, robot, "fan_hz")
    assert shown["usual_low"] > 20
    assert (shown["high"], shown["low"], shown["advice"]) == (None, None, "")


def test_lasting_effort_is_told_and_positions_are_not_judged(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair

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
    assert [item["field"] for item in diagnostics(anna, robot)["fields"]] == ["effort_nm.0"]
    cloud.run(ingest_telemetry(cloud.functions, list(joints(-130.0))))
    (fault,) = open_faults(anna, robot)
    assert (fault["kind"], fault["limit"], fault["stream"]) == ("level", -120.0, "joints")


def test_devices_stand_worst_first_in_their_space_and_with_counts(cloud: Cloud) -> None:
    with paired(cloud, "anna", "arm", "leg") as (anna, robot):
        life = Life(cloud, robot)
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
        pages = []
        cursor = None
        while True:
            page = anna.get("/diagnostics", params={"limit": 1, **({"cursor": cursor} if cursor else {})}).json()
            pages += page["items"]
            cursor = page["cursor"]
            if cursor is None:
                break
        assert sorted(item["device"] for item in pages) == sorted(item["device"] for item in listed["items"])
        bert = cloud.sign_in("bert")
        assert bert.get("/diagnostics").json()["items"] == []
        problem(bert.get(f"/spaces/{robot.space}/diagnostics"), 404, "space-unknown")
        problem(bert.get(f"/devices/{robot.device}/diagnostics"), 404, "device-unknown")
        problem(anna.get("/diagnostics", params={"cursor": "x"}), 422, "cursor-invalid")


def test_a_new_owner_begins_with_nothing(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    Life(cloud, robot).live(4, temperature_c__elbow=still(90))
    assert diagnostics(anna, robot)["fields"]
    anna.delete(f"/agents/{robot.id}")
    bert = cloud.sign_in("bert")
    robot.pair(bert)
    assert (diagnostics(bert, robot)["fields"], diagnostics(bert, robot)["faults"]) == ([], [])


def test_several_workers_see_one_fault_and_lose_no_window(open_cloud: Any, cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    clouds = [cloud, open_cloud(clock=cloud.clock), open_cloud(clock=cloud.clock)]
    batch = list(Life(cloud, robot).messages(12, temperature_c__elbow=still(90), temperature_c__wrist_1=still(30)))
    calls = [one.begin(ingest_telemetry(one.functions, batch)) for one in clouds for _ in "ab"]
    for finish in calls:
        finish()
    assert [fault["code"] for fault in open_faults(anna, robot)] == ["health.temperature_c.elbow"]
    assert diagnostics(anna, robot)["fields"][0]["value"] == pytest.approx(90, abs=1)


def test_what_a_killed_worker_left_is_put_right_within_a_minute(
    cloud: Cloud, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    anna, robot = pair
    life = Life(cloud, robot)
    life.live(2, temperature_c__elbow=still(40))
    real = cloud.functions.tables.replace

    async def dying(table: str, row: Any) -> Any:
        if table == records.DIAGNOSTICS:
            raise RuntimeError("killed")
        return await real(table, row)

    monkeypatch.setattr(cloud.functions.tables, "replace", dying)
    life.live(4, temperature_c__elbow=still(90))
    assert len(open_faults(anna, robot)) == 1, "the fault was written before the watch that found it was not"
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
        life = Life(cloud, robot)
        life.live(130, **many)
        fields = diagnostics(anna, robot)["fields"]
        assert [item["field"] for item in fields] == sorted(many)[:100]
        row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
        assert row is not None
        partition = f"{robot.device}/{row.data['pairing']}"
        kept = cloud.run(cloud.functions.tables.get(records.DIAGNOSTICS, partition, "health"))
        assert kept is not None
        assert len(codec.encode(kept.data)) < 200_000


def test_what_an_earlier_pairing_left_is_forgotten(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    Life(cloud, robot).live(4, temperature_c__elbow=still(90))
    sample = {"at_ms": cloud.clock.now_ms(), "ms": 5.0}
    latency = {"transport": "mqtt", "path": "operator-device", "samples": [sample]}
    assert anna.post(f"/devices/{robot.device}/latency", latency).status_code == 204
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    partition = f"{robot.device}/{row.data['pairing']}"

    def left() -> set[str]:
        tables = (records.FAULTS, records.DIAGNOSTICS, records.LATENCY)
        pages = {table: cloud.run(cloud.functions.tables.query(table, partition)) for table in tables}
        # How often a code was raised has a note of its own, and says itself how long it stays.
        return {table for table, page in pages.items() if any("expires_ms" not in row.data for row in page.rows)}

    assert left() == {records.FAULTS, records.DIAGNOSTICS, records.LATENCY}
    anna.delete(f"/agents/{robot.id}")
    cloud.clock.advance(2 * 3600)
    cloud.sweep()
    assert left() == set()
