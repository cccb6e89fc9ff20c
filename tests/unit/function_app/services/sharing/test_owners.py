"""Operations that would leave no owner are refused; the error names the alternative."""

import pytest

from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.sharing.shares import share


@pytest.fixture(autouse=True)
def shared(anna: Person, bert: Person, robot: Robot) -> None:
    """Bert operates the robot."""
    share(anna, f"devices/{robot.device}", bert, "operator")


def stands(anna: Person, bert: Person, robot: Robot) -> None:
    """Check that roles, shares and lease are unchanged."""
    assert anna.get(f"/devices/{robot.device}").json()["role"] == "owner"
    assert bert.get(f"/devices/{robot.device}").json()["role"] == "operator"
    assert [each["account"]["name"] for each in anna.get(f"/devices/{robot.device}/shares").json()["items"]] == ["bert"]
    assert anna.take_lease(robot.device).status_code == 200


@pytest.mark.parametrize("kind", ["devices", "spaces"])
def test_an_owner_cannot_leave_or_get_a_lower_role(anna: Person, bert: Person, robot: Robot, kind: str) -> None:
    at = f"/{kind}/{robot.device if kind == 'devices' else robot.space}/shares"
    left = problem(anna.delete(f"{at}/{anna.account}"), 409, "already-owner")
    lowered = problem(anna.post(at, {"account": "anna", "role": "viewer"}), 422, "invalid")
    for error in (left, lowered):
        assert "transfer" in error["detail"].lower()
    assert bert.delete(f"{at}/{anna.account}").status_code in {403, 404}
    stands(anna, bert, robot)


def test_unknown_accounts_are_refused(anna: Person, bert: Person, robot: Robot) -> None:
    anna.post("/spaces", {"name": "second"})
    for path, body in (
        (f"/agents/{robot.id}/transfers", {}),
        (f"/spaces/{robot.space}/transfers", {}),
        (f"/devices/{robot.device}/invitations", {"role": "viewer"}),
        (f"/devices/{robot.device}/shares", {"role": "viewer"}),
    ):
        error = problem(anna.post(path, {"account": "unknown", **body}), 404, "account-unknown")
        assert "'unknown'" in error["detail"]
        assert "invitation" in error["detail"], "the error names the alternative"
    assert anna.get(f"/agents/{robot.id}/transfers").json()["items"] == []
    stands(anna, bert, robot)


@pytest.mark.parametrize("role", ["viewer", "owner"])
def test_the_owner_cannot_use_up_an_own_invitation(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot, role: str
) -> None:
    transfers = f"/agents/{robot.id}/transfers"
    problem(anna.post(transfers, {"account": "anna"}), 409, "already-owner")
    path, body = (transfers, {}) if role == "owner" else (f"/devices/{robot.device}/invitations", {"role": role})
    secret = {"secret": anna.post(path, body).json()["secret"]}
    problem(anna.post("/invitations/redeem", secret), 409, "already-owner")
    stands(anna, bert, robot)
    anna.delete(f"/devices/{robot.device}/lease?epoch=1")
    clara = cloud.sign_in("clara")
    assert clara.post("/invitations/redeem", secret).status_code == 200
    assert clara.get(f"/devices/{robot.device}").json()["role"] == role


def test_the_last_space_cannot_be_transferred(anna: Person, bert: Person, robot: Robot) -> None:
    problem(anna.post(f"/spaces/{robot.space}/transfers", {}), 409, "last-space")
    second = anna.post("/spaces", {"name": "second"}).json()["id"]
    offers = [anna.post(f"/spaces/{space}/transfers", {}).json() for space in (second, robot.space)]
    assert bert.post("/invitations/redeem", {"secret": offers[0]["secret"]}).status_code == 200
    error = problem(bert.post("/invitations/redeem", {"secret": offers[1]["secret"]}), 409, "last-space")
    assert "anna" in error["detail"]
    stands(anna, bert, robot)
    anna.post("/spaces", {"name": "third"})
    assert bert.post("/invitations/redeem", {"secret": offers[1]["secret"]}).status_code == 200
    assert bert.get(f"/devices/{robot.device}").json()["role"] == "owner"
    assert [each["name"] for each in anna.get("/spaces").json()["items"]] == ["third"]
