"""What the cloud stores of presence, descriptions, states and events, and which messages it drops."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from device_agent.protocol import Description, Event, Fault, Mode, Presence, State, Twin, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.versions import VersionRange
from function_app.domain.common.ids import command_id
from function_app.domain.common.json_depth import MAX_LEVELS
from function_app.domain.common.timestamps import LAST_MS, rfc3339
from function_app.domain.devices.devices import Agent, DeviceEpochs, LastState, Link
from function_app.services.devices.control_rows import EPOCHS
from function_app.services.messaging.presence import SAME_STOP_MS
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.cloud.memory import Memory

PRESENCE = Presence(
    online=True, session=7, at_ms=5, protocol=VersionRange(min=1, max=3), capabilities=("move_joints", "home")
)
FAULTS = (Fault(code="driver", message="no answer", since_ms=3),)
STATE = State(device="arm", at_ms=5, tick_ms=6, mode=Mode.IDLE, epoch=9, ended_epoch=8, faults=FAULTS)
DESCRIPTION = Description(device="arm", kind="arm", robot_type="ur5", label="new")


def event(**changes: Any) -> Event:
    fields: dict[str, Any] = {
        "id": "e1",
        "device": "arm",
        "at_ms": 5,
        "kind": "bump",
        "severity": "info",
        "message": "m",
    }
    return Event(**(fields | changes))


def nested(levels: int) -> Any:
    """A list in this many lists."""
    return [] if levels == 1 else [nested(levels - 1)]


class PresenceFixture:
    """The ingest, a paired agent, and what is stored about it."""

    def __init__(self, cloud: Cloud, robot: Robot) -> None:
        self.cloud = cloud
        self.robot = robot

    def ingest(self, kind: str, message: Any, *, name: str = "", **options: Any) -> None:
        place = (self.robot.space, self.robot.id)
        topic = topics.conn(*place) if kind == topics.CONN else topics.device(*place, "arm", kind, name)
        self.ingest_at(topic, message, **options)

    def ingest_at(self, topic: str, message: Any, *, by: Any = "mqtt") -> None:
        self.cloud.run(self.cloud.functions.presence.ingest(topics.parse(topic), codec.encode(message), by=by))

    def stored(self, table: str, partition: str, key: str, kind: type[Any]) -> Any:
        return self.cloud.run(records.find(self.cloud.functions.tables, table, partition, key, kind))[1]

    @property
    def agent(self) -> Agent:
        agent: Agent = self.stored(records.AGENTS, self.robot.id, "agent", Agent)
        return agent

    @property
    def link(self) -> Link:
        link: Link = self.stored(records.AGENTS, self.robot.id, "link", Link)
        return link

    @property
    def state(self) -> LastState | None:
        state: LastState | None = self.stored(records.AGENTS, self.robot.id, "state:arm", LastState)
        return state

    def change_agent(self, change: Callable[[Agent], Agent]) -> None:
        changed = change(self.agent)
        place = (records.AGENTS, self.robot.id, "agent")
        self.cloud.run(records.upsert(self.cloud.functions.tables, *place, lambda _: changed, Agent))

    def rows(self) -> list[Any]:
        """The rows of all agents."""
        assert self.cloud.memory is not None
        return self.cloud.memory.tables.rows(records.AGENTS, records.CONTROL)


@pytest.fixture
def fixture(cloud: Cloud, robot: Robot) -> PresenceFixture:
    return PresenceFixture(cloud, robot)


def test_presence_is_stored_as_the_link_of_the_agent(fixture: PresenceFixture) -> None:
    fixture.ingest(topics.CONN, PRESENCE)
    now_ms = fixture.cloud.clock.now_ms()
    assert fixture.link == Link(
        online=True,
        session=7,
        seen_ms=now_ms,
        polled=False,
        pairing=fixture.agent.pairing,
        protocol=(1, 3),
        capabilities=("move_joints", "home"),
    )


def test_the_will_of_an_earlier_connection_is_ignored(fixture: PresenceFixture) -> None:
    fixture.ingest(topics.CONN, PRESENCE)
    for session, online in ((6, True), (7, False)):
        fixture.ingest(topics.CONN, Presence(online=False, session=session, at_ms=6))
        assert (fixture.link.session, fixture.link.online) == (7, online)


@pytest.mark.parametrize(("transport", "polled"), [("http", True), ("xmpp", False)])
def test_only_an_agent_over_http_counts_as_polling(fixture: PresenceFixture, transport: Any, polled: bool) -> None:
    fixture.change_agent(lambda agent: replace(agent, transport=transport))
    fixture.ingest(topics.CONN, PRESENCE, by=transport)
    assert (fixture.link.session, fixture.link.polled) == (7, polled)


def test_only_an_agent_that_connects_is_watched_for_silence(fixture: PresenceFixture, memory: Memory) -> None:
    memory.tables.drop(records.WATCHED)
    fixture.ingest(topics.CONN, Presence(online=False, session=7, at_ms=5))
    assert memory.tables.rows(records.WATCHED) == []
    fixture.ingest(topics.CONN, Presence(online=True, session=8, at_ms=5))
    assert f"agent:{fixture.robot.id}" in {row.key for _, row in memory.tables.rows(records.WATCHED)}


def test_a_state_is_stored_with_its_epochs_and_faults(fixture: PresenceFixture, memory: Memory) -> None:
    fixture.ingest(topics.STATE, State(device="arm", at_ms=4, tick_ms=5, mode=Mode.ACTION, epoch=8))
    fixture.ingest(topics.STATE, STATE)
    now_ms = fixture.cloud.clock.now_ms()
    pairing = fixture.agent.pairing
    last = fixture.state
    assert last is not None
    assert (msgspec.convert(last.state, State), last.seen_ms, last.pairing) == (STATE, now_ms, pairing)
    epochs = fixture.stored(records.CONTROL, fixture.robot.device, EPOCHS, DeviceEpochs)
    assert epochs == DeviceEpochs(seen=9, ended=8, pairing=pairing)
    assert "driver" in str(memory.tables.rows(records.FAULTS))


def test_a_description_is_stored_but_a_twin_is_not(fixture: PresenceFixture) -> None:
    fixture.ingest(topics.DESC, DESCRIPTION)
    fixture.ingest(topics.DESC, Twin(device="arm", bodies=()), name=topics.TWIN)
    assert fixture.stored(records.DESCRIPTIONS, fixture.robot.id, "arm", Description) == DESCRIPTION


@pytest.mark.parametrize(
    ("transport", "by", "stored"),
    [("mqtt", "mqtt", True), ("mqtt", "http", True), ("http", "http", True), ("http", "mqtt", False)],
)
def test_a_message_that_the_functions_have_relayed_is_not_stored_again(
    fixture: PresenceFixture, transport: Any, by: str, stored: bool
) -> None:
    fixture.change_agent(lambda agent: replace(agent, transport=transport))
    fixture.ingest(topics.STATE, STATE, by=by)
    assert (fixture.state is not None) is stored


def test_messages_of_other_spaces_devices_and_agents_are_dropped(fixture: PresenceFixture) -> None:
    space, agent = fixture.robot.space, fixture.robot.id
    rows = fixture.rows()
    for topic in (
        topics.device("other", agent, "arm", topics.STATE),
        topics.device(space, agent, "leg", topics.STATE),
        topics.device(space, "b" * len(agent), "arm", topics.STATE),
    ):
        fixture.ingest_at(topic, STATE)
    assert fixture.rows() == rows


class TestEvents:
    def test_an_event_is_stored_with_its_data(self, fixture: PresenceFixture, anna: Person) -> None:
        fixture.ingest(topics.EVENT, event(data={"count": 2}))
        (stored,) = anna.get(f"/devices/{fixture.robot.device}/events").json()["items"]
        assert (stored["id"], stored["kind"], stored["data"]) == ("e1", "bump", {"count": 2})

    @pytest.mark.parametrize(
        ("accepted", "rejected"),
        [
            ({"data": {"deep": nested(MAX_LEVELS - 1)}}, {"data": {"deep": nested(MAX_LEVELS)}}),
            ({"at_ms": LAST_MS}, {"at_ms": LAST_MS + 1}),
        ],
        ids=["depth", "time"],
    )
    def test_an_event_beyond_a_limit_is_rejected(
        self, fixture: PresenceFixture, anna: Person, accepted: dict[str, Any], rejected: dict[str, Any]
    ) -> None:
        with pytest.raises(ProtocolError):
            fixture.ingest(topics.EVENT, event(**rejected))
        fixture.ingest(topics.EVENT, event(**accepted))
        assert len(anna.get(f"/devices/{fixture.robot.device}/events").json()["items"]) == 1

    def test_the_record_of_a_stop_without_author_and_reason(self, fixture: PresenceFixture, anna: Person) -> None:
        fixture.ingest(topics.EVENT, event(kind="stop-latched", message="st\u202eop"))
        record = anna.get("/accounts/me/audit").json()["items"][0]
        unknown = "unknown (unverified)"
        assert (record["event"], record["target"], record["at"]) == ("stop-latched", fixture.robot.device, rfc3339(5))
        assert (record["outcome"], record["actor"]) == ("done", unknown)
        assert record["data"] == {"message": "st\ufffdop", "caller": unknown, "reason": "", "verified": False}

    def test_each_reported_stop_is_recorded_once(self, fixture: PresenceFixture, anna: Person) -> None:
        for id_ in ("e1", "e1", "e2"):
            fixture.ingest(topics.EVENT, event(id=id_, kind="stop-latched", message=id_))
        items = anna.get("/accounts/me/audit").json()["items"]
        assert [item["data"]["message"] for item in items if item["event"] == "stop-latched"] == ["e2", "e1"]

    @pytest.mark.parametrize(("age_ms", "records_"), [(SAME_STOP_MS, 0), (SAME_STOP_MS + 1, 1)])
    def test_a_report_of_a_stop_within_a_minute_of_its_record_is_not_recorded(
        self, fixture: PresenceFixture, anna: Person, age_ms: int, records_: int
    ) -> None:
        stop = command_id(fixture.robot.device, fixture.cloud.clock.now_ms())
        fixture.ingest(topics.EVENT, event(id=stop, at_ms=fixture.cloud.clock.now_ms()))
        fixture.cloud.clock.advance((age_ms - 1) / 1000)  # each call takes one millisecond
        fixture.ingest(topics.EVENT, event(kind="stop-latched", data={"stop": stop}))
        kinds = [record["event"] for record in anna.get("/accounts/me/audit").json()["items"]]
        assert kinds.count("stop-latched") == records_
