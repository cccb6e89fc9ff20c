"""Current viewers of a device, and its label."""

import pytest

from function_app.services.devices import viewers
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Robot:
    """Anna's robot, which is not connected."""
    robot = cloud.robot()
    robot.pair(anna)
    return robot


def view(person: Person, robot: Robot) -> list[tuple[str, str, bool]]:
    """View the device and return the other viewers."""
    answer = person.put(f"/devices/{robot.device}/viewers", None)
    assert answer.status_code == 200, answer.text
    return [(other["name"], other["role"], other["mine"]) for other in answer.json()["items"]]


def rows(cloud: Cloud, robot: Robot) -> dict[str, str]:
    page = cloud.run(cloud.functions.tables.query(records.WATCHERS, robot.device, limit=1000))
    return {row.key: row.etag for row in page.rows}


class TestViewing:
    def test_each_viewer_sees_the_others_while_they_view(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        again, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
        path = f"/devices/{robot.device}/viewers"
        for method in (lambda: bert.put(path, None), lambda: bert.delete(path)):
            problem(method(), 404, "device-unknown")
        assert anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "viewer"}).status_code == 201
        assert view(anna, robot) == []
        cloud.clock.advance(1)
        assert view(bert, robot) == [("anna", "owner", False)]
        cloud.clock.advance(1)
        assert view(again, robot) == [("anna", "owner", True), ("bert", "viewer", False)]
        cloud.clock.advance(20)
        assert view(bert, robot) == [("anna", "owner", False), ("anna", "owner", False)]
        cloud.clock.advance(8)
        assert view(anna, robot) == [("bert", "viewer", False)], "a viewer without reports is removed"
        assert bert.delete(path).status_code == 204
        assert view(anna, robot) == [], "a viewer that leaves is removed immediately"

    def test_the_start_is_that_of_the_uninterrupted_view(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        again = cloud.sign_in("anna")

        def since() -> str:
            (other,) = again.put(f"/devices/{robot.device}/viewers", None).json()["items"]
            return str(other["since"])

        view(anna, robot)
        first = since()
        for _ in range(4):
            cloud.clock.advance(10)
            view(anna, robot)
        assert since() == first
        cloud.clock.advance(30)
        view(anna, robot)
        assert since() > first

    def test_rows_are_bounded_and_deleted(
        self, cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(viewers, "MAX_VIEWERS", 3)
        people = [anna, *(cloud.sign_in("anna") for _ in range(4))]
        assert [len(view(person, robot)) for person in people] == [0, 1, 2, 3, 3]
        assert len(rows(cloud, robot)) == 3
        cloud.clock.advance(26)
        assert view(people[4], robot) == []
        assert len(rows(cloud, robot)) == 1, "the next viewer deletes expired rows"
        cloud.clock.advance(3 * 3600)
        cloud.run(cloud.functions.retention.delete_due(cloud.clock.now_ms()))
        assert rows(cloud, robot) == {}

    def test_an_immediate_repetition_writes_nothing(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        view(anna, robot)
        first = rows(cloud, robot)
        cloud.clock.advance(2)
        view(anna, robot)
        assert rows(cloud, robot) == first
        cloud.clock.advance(4)
        view(anna, robot)
        assert rows(cloud, robot) != first


class TestLabel:
    def test_everyone_with_access_sees_the_owners_label(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        bert = cloud.sign_in("bert")
        path = f"/devices/{robot.device}/label"
        anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "operator"})
        before = anna.get(f"/devices/{robot.device}").json()["label"]
        assert anna.put(path, {"label": " Left\n arm "}).json()["label"] == "Left arm"
        assert [each["label"] for each in bert.get("/devices").json()["items"]] == ["Left arm"]
        robot.enroll()
        assert bert.get(f"/devices/{robot.device}").json()["label"] == "Left arm", "enrolling again changes nothing"
        problem(bert.put(path, {"label": "Mine"}), 403, "forbidden")
        assert anna.put(path, {"label": None}).json()["label"] == before
        audited = [each["event"] for each in anna.get("/accounts/me/audit").json()["items"]]
        assert audited.count("device-renamed") == 2
        for invalid in ("", " \n", "a\x00b", "x" * 81, 7):
            problem(anna.put(path, {"label": invalid}), 422, "invalid")

    def test_a_new_owner_sees_neither_label_nor_viewers(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        bert = cloud.sign_in("bert")
        before = anna.get(f"/devices/{robot.device}").json()["label"]
        anna.put(f"/devices/{robot.device}/label", {"label": "Anna's own"})
        view(anna, robot)
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        robot.pair(bert)
        assert bert.get(f"/devices/{robot.device}").json()["label"] == before
        assert view(bert, robot) == []
