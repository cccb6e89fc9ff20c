"""Who looks at a device at this moment, and what its owner calls it."""

from typing import Any

import pytest

from function_app.services.devices import viewers
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.clock import MovingClock
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory


@pytest.fixture
def clock(memory: Memory) -> MovingClock:
    return memory.clock


@pytest.fixture
def alone(open_cloud: OpenCloud) -> Cloud:
    """The functions where no broker is needed, with a clock that moves."""
    return open_cloud()


def claimed(cloud: Cloud, owner: Person) -> Robot:
    robot = cloud.robot()
    code = robot.enroll().json()["claim_code"]
    assert owner.post("/agents/claim", {"code": code}).status_code == 200
    return robot


def looks(person: Person, robot: Robot) -> list[tuple[str, str, bool]]:
    answer = person.put(f"/devices/{robot.device}/viewers", None)
    assert answer.status_code == 200, answer.text
    return [(other["name"], other["role"], other["mine"]) for other in answer.json()["items"]]


def rows(cloud: Cloud, robot: Robot) -> int:
    return len(cloud.run(cloud.functions.tables.query(records.WATCHERS, robot.device, limit=1000)).rows)


class TestWatching:
    def test_each_is_told_of_the_others_for_as_long_as_they_say_so(self, alone: Cloud, clock: MovingClock) -> None:
        anna, again, bert = alone.sign_in("anna"), alone.sign_in("anna"), alone.sign_in("bert")
        robot = claimed(alone, anna)
        assert anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "viewer"}).status_code == 201
        assert looks(anna, robot) == []
        clock.advance(1)
        assert looks(bert, robot) == [("anna", "owner", False)]
        clock.advance(1)
        assert looks(again, robot) == [("anna", "owner", True), ("bert", "viewer", False)]
        clock.advance(20)
        assert looks(bert, robot) == [("anna", "owner", False), ("anna", "owner", False)]
        clock.advance(8)
        assert looks(anna, robot) == [("bert", "viewer", False)], "who says nothing is gone"
        assert bert.delete(f"/devices/{robot.device}/viewers").status_code == 204
        assert looks(anna, robot) == [], "and who says so is gone at once"

    def test_since_when_is_from_the_first_word_without_a_pause(self, alone: Cloud, clock: MovingClock) -> None:
        anna, again = alone.sign_in("anna"), alone.sign_in("anna")
        robot = claimed(alone, anna)

        def since() -> str:
            (other,) = again.put(f"/devices/{robot.device}/viewers", None).json()["items"]
            return str(other["since"])

        looks(anna, robot)
        first = since()
        for _ in range(4):
            clock.advance(10)
            looks(anna, robot)
        assert since() == first
        clock.advance(30)
        looks(anna, robot)
        assert since() > first

    def test_who_may_not_see_it_neither_watches_nor_learns_who_does(self, alone: Cloud) -> None:
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert")
        robot = claimed(alone, anna)
        looks(anna, robot)
        for method in (lambda path: bert.put(path, None), bert.delete):
            problem(method(f"/devices/{robot.device}/viewers"), 404, "device-unknown")
        assert looks(anna, robot) == []

    def test_who_watched_an_earlier_owners_pairing_is_not_told_of(self, alone: Cloud) -> None:
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert")
        robot = claimed(alone, anna)
        looks(anna, robot)
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        code = robot.enroll().json()["claim_code"]
        assert bert.post("/agents/claim", {"code": code}).status_code == 200
        assert looks(bert, robot) == []

    def test_rows_stay_few_and_are_forgotten(
        self, alone: Cloud, clock: MovingClock, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(viewers, "MOST", 3)
        people = [alone.sign_in("anna") for _ in range(5)]
        robot = claimed(alone, people[0])
        told = [len(looks(person, robot)) for person in people]
        assert (told, rows(alone, robot)) == ([0, 1, 2, 3, 3], 3)
        clock.advance(26)
        assert looks(people[4], robot) == []
        assert rows(alone, robot) == 1, "what was over is tidied up by who comes"
        clock.advance(3 * 3600)
        alone.run(alone.functions.retention.delete_due(clock.now_ms()))
        assert rows(alone, robot) == 0

    def test_what_is_said_again_at_once_writes_nothing(self, alone: Cloud, clock: MovingClock) -> None:
        anna = alone.sign_in("anna")
        robot = claimed(alone, anna)

        def etag() -> Any:
            return alone.run(alone.functions.tables.get(records.WATCHERS, robot.device, anna.session))

        looks(anna, robot)
        first = etag()
        clock.advance(2)
        looks(anna, robot)
        assert etag() == first
        clock.advance(4)
        looks(anna, robot)
        assert etag() != first


class TestNaming:
    def test_everybody_sees_what_the_owner_calls_it_until_they_call_it_as_before(self, alone: Cloud) -> None:
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert")
        robot = claimed(alone, anna)
        anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "operator"})
        before = anna.get(f"/devices/{robot.device}").json()["label"]
        assert anna.put(f"/devices/{robot.device}/label", {"label": " Left\n arm "}).json()["label"] == "Left arm"
        assert [each["label"] for each in bert.get("/devices").json()["items"]] == ["Left arm"]
        robot.enroll()
        assert bert.get(f"/devices/{robot.device}").json()["label"] == "Left arm", "enrolling again changes nothing"
        problem(bert.put(f"/devices/{robot.device}/label", {"label": "Mine"}), 403, "forbidden")
        assert anna.put(f"/devices/{robot.device}/label", {"label": None}).json()["label"] == before
        whats = [each["event"] for each in anna.get("/accounts/me/audit").json()["items"]]
        assert whats.count("device-renamed") == 2

    @pytest.mark.parametrize("label", ["", " \n", "a\x00b", "x" * 81, 7])
    def test_what_is_no_name_is_refused(self, alone: Cloud, label: object) -> None:
        anna = alone.sign_in("anna")
        robot = claimed(alone, anna)
        problem(anna.put(f"/devices/{robot.device}/label", {"label": label}), 422, "invalid")

    def test_a_new_owner_finds_it_called_as_its_agent_calls_it(self, alone: Cloud) -> None:
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert")
        robot = claimed(alone, anna)
        before = anna.get(f"/devices/{robot.device}").json()["label"]
        anna.put(f"/devices/{robot.device}/label", {"label": "Anna's own"})
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        code = robot.enroll().json()["claim_code"]
        assert bert.post("/agents/claim", {"code": code}).json()["devices"][0]["label"] == before
