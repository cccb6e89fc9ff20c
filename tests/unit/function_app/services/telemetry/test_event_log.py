"""Only accounts with access to a device can read its events, page by page."""

from typing import Any

from device_agent.protocol import Event, codec, topics
from device_agent.protocol.events import EventKind
from function_app.entrypoints.ingest.router import ingest
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person

Pair = tuple[Person, Robot]


def happened(cloud: Cloud, robot: Robot, number: int, **changes: Any) -> None:
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


def test_they_are_shown_newest_first_page_by_page_with_both_times(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    for number in (2, 0, 3, 1, 4, 4):
        happened(cloud, robot, number)
    shown: list[dict[str, Any]] = []
    cursor = None
    while True:
        query = {"limit": 2} | ({"cursor": cursor} if cursor else {})
        page = anna.get(f"/devices/{robot.device}/events", params=query).json()
        assert len(page["items"]) <= 2
        shown += page["items"]
        cursor = page["cursor"]
        if cursor is None:
            break
    assert [event["id"] for event in shown] == ["e4", "e3", "e2", "e1", "e0"]
    newest = shown[0]
    assert newest["data"] == {"code": "expired", "epoch": 4}
    assert (newest["kind"], newest["severity"]) == ("command-rejected", "warning")
    assert newest["at"] < newest["received_at"]


def test_a_cursor_of_another_list_is_refused(pair: Pair) -> None:
    anna, robot = pair
    answer = anna.get(f"/devices/{robot.device}/events", params={"cursor": "%%%"})
    assert answer.status_code == 422
    assert answer.json()["type"].endswith("cursor-invalid")


def test_other_accounts_and_later_owners_cannot_read_earlier_events(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    happened(cloud, robot, 1)
    bert = cloud.sign_in("bert")
    assert bert.get(f"/devices/{robot.device}/events").status_code == 404
    assert anna.delete(f"/agents/{robot.id}").status_code in {200, 204}
    robot.pair(bert)
    assert bert.get(f"/devices/{robot.device}/events").json() == {"items": [], "cursor": None}
    happened(cloud, robot, 2)
    assert [event["id"] for event in bert.get(f"/devices/{robot.device}/events").json()["items"]] == ["e2"]


def test_a_time_that_is_none_is_let_go(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    happened(cloud, robot, 1, at_ms=2**52)
    assert anna.get(f"/devices/{robot.device}/events").json()["items"] == []
