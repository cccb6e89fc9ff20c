"""Cleanup after an agent is unpaired or moved, or a device is removed."""

from typing import Any

import pytest

from device_agent.protocol import Description, Mode, MoveJoints, State, topics
from function_app.services.maintenance.scheduler import ORPHAN_MS
from function_app.services.pairing.offboarding import CHECK_MS
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.fixtures.cloud import Crashing
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.crash_injection import at_instance

Pair = tuple[Person, Robot]


def furnish(anna: Person, robot: Robot, name: str = "arm") -> tuple[str, str]:
    """Publish retained messages of a device, start an action and queue another one."""
    device = f"{robot.id}-{name}"
    state = State(device=name, at_ms=1, tick_ms=1, mode=Mode.IDLE, epoch=0)
    robot.publish(robot.topic(topics.STATE, name), state, retain=True)
    description = Description(device=name, kind="arm", robot_type="ur5", label="")
    robot.publish(robot.topic(topics.DESC, name), description, retain=True)
    robot.publish(topics.device(robot.space, robot.id, name, topics.DESC, topics.TWIN), {"x": 1}, retain=True)
    running = anna.start(device, wait_ms=10_000).json()["id"]
    waiting = anna.start(device, policy="queue").json()
    assert waiting["status"] == "queued"
    return running, waiting["id"]


def retained(cloud: Cloud, broker: MemoryBroker, space: str, agent: str, name: str) -> set[str]:
    """Topics of a device and its agent with a retained message."""
    filters = [f"{topics.ROOT}/{space}/{agent}/{name}/{kind}" for kind in ("state", "desc", "desc/twin")]
    filters.append(topics.conn(space, agent))
    grant = broker.grant("look", publish=("look/x",), subscribe=tuple(filters))
    with broker.connect("look", cloud.run(cloud.functions.access.issue(grant))) as client:
        client.subscribe(*filters)
        return {message.topic for message in client.pending()}


def ends(cloud: Cloud, *actions: str) -> set[tuple[str, str]]:
    """Status and reason of each action, independent of the current owner."""
    found = [cloud.run(cloud.functions.start_action._action_store.get(action)) for action in actions]
    return {(each.action.status.value, (each.action.reason or {}).get("code", "")) for each in found if each}


def rest(cloud: Cloud, robot: Robot) -> dict[str, Any]:
    """Departures and reminders of an agent that remain in the tables."""
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    pages = [cloud.run(cloud.functions.tables.query(records.PENDING, str(shard))) for shard in range(SHARDS)]
    notes = [note.key for page in pages for note in page.rows if ":leave:" in note.key or ":queue:" in note.key]
    assert row is not None
    return {"leaving": list(row.data["leaving"]), "notes": notes}


def pass_time(cloud: Cloud) -> None:
    for seconds in (1, CHECK_MS / 1000, 1, ORPHAN_MS / 1000 + 1, 1):
        cloud.clock.advance(seconds)
        cloud.sweep()


def test_unpairing_ends_actions_and_clears_retained_messages(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
) -> None:
    running, waiting = furnish(anna, robot)
    space = robot.space
    assert len(retained(cloud, broker, space, robot.id, "arm")) == 4
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    assert ends(cloud, running, waiting) == {("failed", "unpaired")}
    assert retained(cloud, broker, space, robot.id, "arm") == set()
    assert [command.id for command in robot.received(MoveJoints)] == [running]
    pass_time(cloud)
    assert rest(cloud, robot) == {"leaving": [], "notes": []}
    for table, partition in ((records.MEMBERS, anna.account), (records.DESCRIPTIONS, robot.id)):
        assert cloud.run(cloud.functions.tables.query(table, partition)).rows == ()


def test_a_new_owner_does_not_see_earlier_states(cloud: Cloud, anna: Person, robot: Robot) -> None:
    furnish(anna, robot)
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, f"state:{robot.names[0]}"))
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    assert row is not None
    cloud.run(cloud.functions.tables.create(records.AGENTS, row))  # a late write
    bert = cloud.sign_in("bert")
    robot.pair(bert)
    found = bert.get(f"/devices/{robot.device}").json()
    assert (found["state"], found["online"], found["last_seen_at"]) == (None, False, None)


@pytest.mark.parametrize("after", range(1, 24, 2))
def test_an_unpairing_killed_after_any_write_is_completed_by_the_timer(
    cloud: Cloud, anna: Person, robot: Robot, crashing: Crashing, broker: MemoryBroker, *, after: int
) -> None:
    running, waiting = furnish(anna, robot)
    space = robot.space
    process, crash = crashing(cloud.clock)
    client = at_instance(process, anna)
    assert client.get("/accounts/me").status_code == 200
    crash.left = after
    client.delete(f"/agents/{robot.id}")
    if anna.get(f"/devices/{robot.device}").status_code == 200:
        assert after == 1, "only before the deciding write"
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
    bert = cloud.sign_in("bert")
    robot.pair(bert)
    robot.connect()
    epoch = bert.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
    mine = bert.start(robot.device, epoch=epoch, timeout_ms=600_000, wait_ms=10_000).json()
    assert mine["status"] == "started"
    pass_time(cloud)
    assert ends(cloud, running, waiting) == {("failed", "unpaired")}
    assert retained(cloud, broker, space, robot.id, "arm") == set()
    assert rest(cloud, robot) == {"leaving": [], "notes": []}
    assert bert.get(f"/devices/{robot.device}/lease").json()["lease"]["epoch"] == epoch
    assert bert.action(mine["id"])["status"] == "started"
    assert [item["id"] for item in bert.get("/devices").json()["items"]] == [robot.device]
    assert anna.get("/agents").json()["items"] == []


def test_broker_cleanup_is_completed_after_an_outage(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
) -> None:
    running, waiting = furnish(anna, robot)
    broker.reachable = False
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    broker.reachable = True
    assert ends(cloud, running, waiting) == {("failed", "unpaired")}
    assert len(retained(cloud, broker, robot.space, robot.id, "arm")) == 4
    assert robot.link is not None
    assert not robot.link.disconnected.is_set()
    pass_time(cloud)
    assert robot.link.disconnected.is_set()
    assert retained(cloud, broker, robot.space, robot.id, "arm") == set()
    assert rest(cloud, robot) == {"leaving": [], "notes": []}


class TestMoving:
    def test_it_keeps_the_history_and_ends_running_actions(
        self, cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
    ) -> None:
        running, waiting = furnish(anna, robot)
        before, epoch = robot.space, anna.action(running)["epoch"]
        space = anna.post("/spaces", {"name": "Attic"}).json()["id"]
        answer = anna.put(f"/agents/{robot.id}/space", {"space": space})
        assert (answer.status_code, answer.json()["space"]) == (200, space)
        assert robot.link is not None
        assert robot.link.disconnected.is_set()
        assert {(anna.action(each)["status"], anna.action(each)["reason"]["code"]) for each in (running, waiting)} == {
            ("failed", "moved")
        }
        assert retained(cloud, broker, before, robot.id, "arm") == set()
        robot.space = robot.enrollment()["space"]
        robot.connect()
        assert anna.get(f"/devices/{robot.device}").json()["topic"] == f"ts/v1/{space}/{robot.device.replace('-', '/')}"
        started = anna.start(robot.device, wait_ms=10_000).json()
        assert (started["status"], started["epoch"] > epoch) == ("started", True)
        listed = [item["id"] for item in anna.get(f"/devices/{robot.device}/actions").json()["items"]]
        assert listed == [started["id"], waiting, running]
        pass_time(cloud)
        assert rest(cloud, robot) == {"leaving": [], "notes": []}

    def test_only_own_agents_move_and_only_to_own_spaces(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        action = anna.start(robot.device, wait_ms=10_000).json()["id"]
        bert = cloud.sign_in("bert")
        (foreign,) = bert.get("/spaces").json()["items"]
        problem(anna.put(f"/agents/{robot.id}/space", {"space": foreign["id"]}), 404, "space-unknown")
        problem(bert.put(f"/agents/{robot.id}/space", {"space": foreign["id"]}), 404, "agent-unknown")
        assert anna.put(f"/agents/{robot.id}/space", {"space": robot.space}).status_code == 200
        assert anna.action(action)["status"] == "started", "moving it to its current space has no effect"

    def test_the_first_space_remains_the_default(self, cloud: Cloud) -> None:
        anna = cloud.sign_in("anna")
        (first,) = anna.get("/spaces").json()["items"]
        made = [anna.post("/spaces", {"name": f"s{number}"}).json() for number in range(8)]
        spaces = anna.get("/spaces").json()["items"]
        assert spaces[0] == first
        assert {space["id"] for space in spaces[1:]} == {space["id"] for space in made}
        robot = cloud.robot()
        robot.pair(anna)
        assert robot.space == first["id"]
        problem(anna.post("/spaces", {"name": ""}), 422, "invalid")

    def test_an_account_has_at_most_100_spaces(self, cloud: Cloud) -> None:
        anna = cloud.sign_in("anna")
        assert [anna.post("/spaces", {"name": "s"}).status_code for _ in range(99)] == [201] * 99
        problem(anna.post("/spaces", {"name": "s"}), 409, "too-many-spaces")


def test_removing_a_device_ends_its_actions_only(cloud: Cloud, broker: MemoryBroker) -> None:
    with paired(cloud, "anna", "left", "right") as (anna, robot):
        running, waiting = furnish(anna, robot, "left")
        other, _ = furnish(anna, robot, "right")
        devices = [device for device in robot.introduction()["devices"] if device["name"] == "right"]
        assert robot.enroll(devices=devices).status_code == 200
        assert ends(cloud, running, waiting) == {("failed", "removed")}
        problem(anna.get(f"/actions/{running}"), 404, "action-unknown")
        assert retained(cloud, broker, robot.space, robot.id, "left") == {topics.conn(robot.space, robot.id)}
        assert anna.action(other)["status"] == "started"
        assert robot.link is not None
        assert not robot.link.disconnected.is_set()
        pass_time(cloud)
        assert rest(cloud, robot)["leaving"] == []
