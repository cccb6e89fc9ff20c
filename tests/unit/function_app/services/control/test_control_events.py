"""Control events reach the device's events and the owner's audit log, also after a process was killed."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from function_app.domain.audit.hash_chain import CLOUD
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem, busy_store, forbidden
from function_app.domain.control.control_events import ControlEvent, Fact
from function_app.domain.control.lease import ControlRequest, Lease
from function_app.domain.devices.devices import Agent, Departure, Device
from function_app.domain.identity.accounts import Identity, Role
from function_app.ports.monitoring import Counter, NoMetrics
from function_app.ports.tables import Row, StoreError
from function_app.services.control import control_events
from function_app.services.control.control_events import CHECK_MS, QUIET_MS, event_writes
from function_app.services.devices.control_rows import LEASE
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS
from tests.harness.cloud.cloud import Cloud

AGENT = Agent("abcdefghij", "lab", "key", "1", (), 0, account="owner", space="room", pairing="p2")
ID = f"{AGENT.id}-left-arm"
DEVICE = Device(
    ID,
    "left-arm",
    "",
    "arm",
    "ur5",
    AGENT.id,
    "room",
    "p2",
    Role.OWNER,
    f"ts/v1/room/{AGENT.id}/left-arm",
    owner="owner",
)
BERT = Identity("b", "bert", "s2", key="k")
LEFT = Departure("unpaired", "former", "room", "p1", ("left-arm",))
TAKEN = ControlEvent("control-taken-7", Fact.TAKEN, 5, "bert took control.", {"epoch": 7})
SHOWN = {
    "id": TAKEN.id,
    "device": "left-arm",
    "at_ms": 5,
    "kind": "control-taken",
    "severity": "info",
    "message": TAKEN.message,
    "data": {"epoch": 7},
}
BY_BERT = {"actor": "bert", "account": "b", "session": "s2", "key": "k"}
BY_NO_ONE = dict.fromkeys(BY_BERT, "")


@pytest.fixture
def held(alone: Cloud) -> Lease:
    """A lease of 60 s with a request that may be answered for 10 s."""
    now_ms = alone.clock.now_ms()
    request = ControlRequest("r", 7, "b", "s2", "bert", "a", "s1", now_ms, now_ms + 10_000, 20_000)
    return Lease(7, "a", "s1", "anna", now_ms + 60_000, 60_000, pairing="p2", request=request)


def store(cloud: Cloud, lease: Lease | None, agent: Agent | None = AGENT) -> None:
    rows = [(records.CONTROL, ID, LEASE, lease), (records.AGENTS, AGENT.id, "agent", agent)]
    for table, partition, key, record in rows:
        if record is not None:
            cloud.run(cloud.functions.tables.create(table, Row(partition, key, records.to_data(record))))


def store_event(cloud: Cloud, **options: Any) -> None:
    """Store an event as a process that was killed before it published the event."""
    cloud.run(cloud.functions.tables.batch(records.CONTROL, event_writes(ID, "p2", [TAKEN], **options)))


def check(cloud: Cloud) -> None:
    cloud.run(cloud.functions.control_events.check(ID))


def rows(cloud: Cloud, table: str, partition: str, first: str = "") -> list[Row]:
    page = cloud.run(cloud.functions.tables.query(table, partition, first=first, last=f"{first}~"))
    return list(page.rows)


def events(cloud: Cloud, pairing: str = "p2") -> list[dict[str, Any]]:
    """The events of a pairing, newest first, without the times of their storage."""
    hidden = {"seen_ms", "expires_ms"}
    stored = rows(cloud, records.EVENTS, f"{ID}/{pairing}")
    return [{name: value for name, value in row.data.items() if name not in hidden} for row in stored]


def audited(cloud: Cloud, chain: str) -> list[dict[str, Any]]:
    """The records of a chain, oldest first, without their place in the chain."""
    stored = rows(cloud, records.AUDIT, chain, "record:")
    return [{name: value for name, value in row.data.items() if name not in {"seq", "hash"}} for row in stored]


def reminders(cloud: Cloud) -> set[int]:
    """The times at which the timer checks the lease [ms]."""
    pages = [cloud.run(cloud.functions.tables.query(records.PENDING, str(shard))) for shard in range(SHARDS)]
    keys = [row.key.partition(":") for page in pages for row in page.rows]
    return {int(due) for due, _, what in keys if what == f"lease:{ID}"}


class Counts(NoMetrics):
    """Counts events."""

    def __init__(self) -> None:
        self.events: list[str] = []

    def count(self, counter: Counter, *labels: str, by: int = 1) -> None:
        assert (counter, by) == (Counter.CONTROL_EVENTS, 1)
        self.events += labels


@pytest.fixture
def counts(alone: Cloud) -> Counts:
    alone.functions.metrics = counts = Counts()
    return counts


class TestTimer:
    """Checks of a lease by the timer."""

    def test_it_records_timeouts_for_the_owner(self, alone: Cloud, held: Lease, counts: Counts) -> None:
        store(alone, held)
        alone.clock.advance(60)
        check(alone)
        assert held.request is not None
        expired = {"id": "control-expired-7", "kind": "control-expired", "at_ms": held.expires_ms}
        unanswered = {"id": "control-request-expired-r", "kind": "control-request-expired"}
        data = ({"epoch": 7, "holder": "anna"}, {"request": "r", "requester": "bert", "epoch": 7})
        shown = events(alone)
        assert [event["data"] for event in shown] == list(data)
        assert shown[0].items() >= (expired | {"device": "left-arm", "severity": "info"}).items()
        assert shown[1].items() >= (unanswered | {"at_ms": held.request.expires_ms}).items()
        assert audited(alone, "owner") == [
            {
                "id": f"{ID}/{event['id']}",
                "at_ms": event["at_ms"],
                "event": event["kind"],
                "outcome": "done",
                "target": ID,
                **BY_NO_ONE,
                "data": {"message": event["message"], **event["data"]},
            }
            for event in reversed(shown)
        ]
        assert counts.events == [event["kind"] for event in reversed(shown)]
        check(alone)
        assert (len(events(alone)), len(audited(alone, "owner"))) == (2, 2), "recorded once"

    def test_it_checks_again_at_the_next_timeout(self, alone: Cloud, held: Lease) -> None:
        store(alone, held)
        check(alone)
        assert held.request is not None
        assert reminders(alone) == {held.request.expires_ms}
        alone.clock.advance(10)
        check(alone)
        assert reminders(alone) == {held.request.expires_ms, held.expires_ms}
        alone.clock.advance(50)
        check(alone)
        assert len(reminders(alone)) == 2

    @pytest.mark.parametrize("change", [{"request": None}, {"account": "", "request": None}, {"expires_ms": 0}])
    def test_it_does_not_check_an_ended_lease_again(self, alone: Cloud, held: Lease, change: dict[str, Any]) -> None:
        store(alone, replace(held, **change))
        check(alone)
        assert reminders(alone) == ({held.expires_ms} if change == {"request": None} else set())

    def test_a_device_without_a_lease_needs_no_check(self, alone: Cloud) -> None:
        store(alone, None)
        check(alone)
        assert (events(alone), reminders(alone)) == ([], set())

    def test_a_changed_lease_is_checked_soon(self, alone: Cloud) -> None:
        alone.run(alone.functions.control_events.schedule_check(ID))
        due_ms = alone.clock.now_ms() + CHECK_MS
        assert reminders(alone) == {due_ms}

    @pytest.mark.parametrize(
        ("agent", "pairing", "chain"),
        [
            (AGENT, "p2", "owner"),
            (replace(AGENT, leaving=(LEFT,)), "p2", "owner"),
            (replace(AGENT, leaving=(replace(LEFT, account="x", pairing="p0"), LEFT)), "p1", "former"),
            (replace(AGENT, account=None, pairing="", leaving=(LEFT,)), "p1", "former"),
            (replace(AGENT, leaving=(LEFT,)), "p0", CLOUD),
            (AGENT, "", "owner"),
            (replace(AGENT, account=None, pairing=""), "", CLOUD),
            (None, "p2", CLOUD),
        ],
    )
    def test_it_audits_for_the_owner_of_the_pairing(
        self, alone: Cloud, held: Lease, agent: Agent | None, pairing: str, chain: str
    ) -> None:
        store(alone, replace(held, pairing=pairing, request=None), agent)
        alone.clock.advance(60)
        check(alone)
        assert [record["event"] for record in audited(alone, chain)] == ["control-expired"]
        assert [event["kind"] for event in events(alone, pairing)] == ["control-expired"]


class TestStoredEvents:
    """Events that were stored together with the change of a lease."""

    @pytest.mark.parametrize("how", ["check", "publish"])
    @pytest.mark.parametrize(
        ("options", "chain", "by"),
        [
            ({"owner": "b2"}, "b2", BY_NO_ONE),
            ({"caller": BERT}, "owner", BY_BERT),
            ({"owner": "b2", "caller": BERT}, "b2", BY_BERT),
        ],
    )
    def test_they_are_moved_once(  # noqa: PLR0917 (fixtures and parameters)
        self, alone: Cloud, counts: Counts, how: str, options: dict[str, Any], chain: str, by: dict[str, str]
    ) -> None:
        store(alone, None)
        store_event(alone, **options)
        for _ in "12":
            alone.run(getattr(alone.functions.control_events, how)(ID))
        assert events(alone) == [SHOWN]
        (record,) = audited(alone, chain)
        assert record == {
            "id": f"{ID}/{TAKEN.id}",
            "at_ms": 5,
            "event": "control-taken",
            "outcome": "done",
            "target": ID,
            **by,
            "data": {"message": TAKEN.message, "epoch": 7},
        }
        assert rows(alone, records.CONTROL, ID) == []
        assert counts.events == ["control-taken"]

    def test_the_timer_moves_them_after_contention(self, alone: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
        store(alone, None)
        store_event(alone, owner="owner")

        async def busy(*_: object) -> None:
            raise busy_store()

        with monkeypatch.context() as patch:
            patch.setattr(alone.functions.audit_log, "append_all", busy)
            alone.run(alone.functions.control_events.publish(ID))
            assert len(rows(alone, records.CONTROL, ID)) == 1, "it is not deleted before it is recorded"
            with pytest.raises(Problem, match="concurrent"):
                check(alone)
        check(alone)
        assert [record["event"] for record in audited(alone, "owner")] == ["control-taken"]


class TestDirectEvents:
    """Events without a change of a lease."""

    @pytest.mark.parametrize(
        ("device", "chain"), [(DEVICE, "owner"), (replace(DEVICE, owner=""), CLOUD)], ids=["owned", "unclaimed"]
    )
    def test_a_record_contains_all_fields(self, alone: Cloud, device: Device, chain: str) -> None:
        options: dict[str, Any] = {"caller": BERT, "severity": "warning", "outcome": "failed", "data": {"epoch": 7}}
        recorder = alone.functions.control_events
        alone.run(recorder.record(device, Fact.TAKEN, TAKEN.message, event=(TAKEN.id, 5), **options))
        assert events(alone) == [SHOWN | {"severity": "warning"}]
        (record,) = audited(alone, chain)
        assert record.items() >= {"id": f"{ID}/{TAKEN.id}", "at_ms": 5, "outcome": "failed", **BY_BERT}.items()

    def test_defaults_are_a_new_id_the_current_time_and_no_caller(self, alone: Cloud) -> None:
        recorder = alone.functions.control_events
        for _ in "12":
            alone.run(recorder.record(DEVICE, Fact.TAKEN, TAKEN.message, data={"epoch": 7}))
        now_ms = alone.clock.now_ms()
        newest, oldest = events(alone)
        assert newest["at_ms"] == now_ms
        assert newest | {"id": "", "at_ms": 0} == oldest | {"id": "", "at_ms": 0} == SHOWN | {"id": "", "at_ms": 0}
        assert newest["id"] != oldest["id"]
        assert [record["outcome"] for record in audited(alone, "owner")] == ["done", "done"]
        assert [record["actor"] for record in audited(alone, "owner")] == ["", ""]

    def test_an_event_with_another_audit_record_is_not_audited(self, alone: Cloud) -> None:
        recorder = alone.functions.control_events
        added = alone.run(recorder.add_event(DEVICE, Fact.TAKEN, TAKEN.message, data={"epoch": 7}))
        assert added == SHOWN | {"id": added["id"], "at_ms": alone.clock.now_ms()}
        assert events(alone) == [added]
        assert len(added["id"]) == len(new_id())
        alone.run(recorder.add_event(DEVICE, Fact.SHARED, "text", severity="warning", data={}))
        assert sorted(event["severity"] for event in events(alone)) == ["info", "warning"]
        assert audited(alone, "owner") == []


class TestRejections:
    """Rejections are recorded once in a while for each session and operation."""

    @staticmethod
    def reject(cloud: Cloud, *sessions: str, what: str = "stop", code: str = "forbidden", device: str = ID) -> None:
        problem = Problem(code, 403, "", "Not you.")
        for session in sessions:
            caller = replace(BERT, session=session)
            recorder = cloud.functions.control_events
            cloud.run(recorder.record_rejection(replace(DEVICE, id=device), caller, what, problem))

    @staticmethod
    def sessions(cloud: Cloud) -> Sequence[str]:
        return [record["session"] for record in audited(cloud, "owner")]

    def test_a_rejection_contains_caller_operation_and_code(self, alone: Cloud) -> None:
        self.reject(alone, "s2")
        (event,) = events(alone)
        assert event["data"] == {"caller": "bert", "wanted": "stop", "code": "forbidden"}
        assert (event["kind"], event["severity"]) == ("command-rejected", "warning")
        assert event["message"].endswith("Not you."), "it says why"
        (record,) = audited(alone, "owner")
        assert record.items() >= {"outcome": "rejected", "event": "command-rejected", **BY_BERT}.items()

    def test_the_same_rejection_is_recorded_again_after_a_pause(self, alone: Cloud) -> None:
        self.reject(alone, "s2")
        first_ms = alone.clock.now_ms()
        alone.clock.ahead_ms += QUIET_MS - 2
        self.reject(alone, "s2", "s2")  # each takes 1 ms
        assert alone.clock.now_ms() == first_ms + QUIET_MS
        assert [record["at_ms"] for record in audited(alone, "owner")] == [first_ms, first_ms + QUIET_MS]

    def test_different_rejections_are_recorded(self, alone: Cloud) -> None:
        self.reject(alone, "s2", "s3")
        self.reject(alone, "s2", what="start an action")
        self.reject(alone, "s2", code="lease-held")
        self.reject(alone, "s2", device=f"{AGENT.id}-leg")
        assert len(audited(alone, "owner")) == 5

    def test_the_oldest_rejections_are_forgotten(self, alone: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(control_events, "_CACHE_SIZE", 2)
        self.reject(alone, "a", "b")
        alone.clock.advance(5)
        self.reject(alone, "b")
        assert self.sessions(alone) == ["a", "b"]
        alone.clock.advance(5)
        self.reject(alone, "a", "c", "a", "b")
        assert self.sessions(alone) == ["a", "b", "a", "c", "b"], "b is forgotten"

    @pytest.mark.parametrize("error", [StoreError("The disk is full."), busy_store()])
    def test_a_failed_record_does_not_replace_the_rejection(
        self, alone: Cloud, monkeypatch: pytest.MonkeyPatch, error: Exception
    ) -> None:
        async def fail(*_: object) -> None:
            raise error

        monkeypatch.setattr(alone.functions.audit_log, "append", fail)

        async def attempt() -> None:
            async with alone.functions.control_events.recording_rejections(DEVICE, BERT, "stop"):
                raise forbidden("Not you.")

        with pytest.raises(Problem, match="Not you"):
            alone.run(attempt())

    @pytest.mark.parametrize(("code", "recorded"), [("streaming-unavailable", 1), ("busy", 0)])
    def test_only_rejections_for_lack_of_a_role_or_lease_are_recorded(
        self, alone: Cloud, code: str, recorded: int
    ) -> None:
        async def attempt() -> None:
            async with alone.functions.control_events.recording_rejections(DEVICE, BERT, "stop"):
                raise Problem(code, 409, "", "No.")

        with pytest.raises(Problem, match="No"):
            alone.run(attempt())
        assert len(events(alone)) == recorded
