"""Consent to record cameras: who may decide, its delivery, and the audit log."""

from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.protocol import (
    AckStatus,
    CameraConsent,
    CameraStream,
    Command,
    Description,
    Mode,
    Presence,
    Reason,
    SetCameraConsent,
    State,
    topics,
)
from function_app.ports.command_bus import BusUnavailable
from function_app.services.messaging.delivery import Delivery
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired, problem

CAMERAS = (
    CameraStream(name="front", rate_hz=5.0),
    CameraStream(name="wrist", rate_hz=5.0),
    CameraStream(name="depth", rate_hz=5.0, kind="depth"),
)


class Site:
    """Anna's robot with two cameras."""

    def __init__(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        self.cloud, self.anna, self.robot = cloud, anna, robot
        self.path = f"/devices/{robot.device}/camera-consent"
        description = Description(
            device="arm",
            kind="robot",
            robot_type="ur5",
            label="Arm",
            cameras=CAMERAS,
            watchdog_ms=300,
            max_loop_age_ms=200,
        )
        robot.publish(robot.topic(topics.DESC), description, retain=True)
        cloud.settle()

    def decide(self, *cameras: str, person: Person | None = None) -> Any:
        return (person or self.anna).put(self.path, {"cameras": list(cameras), "wait_ms": 0})

    def sent(self) -> list[tuple[tuple[str, ...], int]]:
        """Cameras and number of each decision that the device has received."""
        self.cloud.settle()
        commands = self.robot.received(SetCameraConsent)
        assert not any(command.epoch for command in commands), "consent is not control"
        requests = [command.request for command in commands]
        return [(each.cameras, each.number) for each in requests if isinstance(each, SetCameraConsent)]

    def report(self, number: int) -> None:
        """The device reports the decision that it has stored."""
        now_ms = self.cloud.clock.now_ms()
        consent = CameraConsent(number=number)
        self.robot.publish_state(
            State(device="arm", at_ms=now_ms, tick_ms=now_ms, mode=Mode.IDLE, epoch=0, camera_consent=consent)
        )
        self.cloud.settle()


@pytest.fixture
def site(cloud: Cloud) -> Iterator[Site]:
    with paired(cloud) as (anna, robot):
        yield Site(cloud, anna, robot)


def test_without_a_decision_no_camera_may_be_recorded(site: Site) -> None:
    expected: dict[str, Any] = {"cameras": [], "by": None, "at": None, "confirmed": True, "reason": None}
    assert site.anna.get(site.path).json() == expected
    site.report(0)
    assert site.sent() == []


def test_the_owners_decision_is_signed_numbered_and_recorded(site: Site) -> None:
    answer = site.decide("front", "front").json()
    assert (answer["cameras"], answer["by"], answer["reason"]) == (["front"], "anna", None)
    assert site.anna.get(site.path).json() == {**answer, "confirmed": False}, "it has not reported its state since"
    site.decide()
    assert site.sent() == [(("front",), 1), ((), 2)]
    command = site.robot.received(SetCameraConsent)[0]
    assert isinstance(command.request, SetCameraConsent)
    assert (command.caller, command.request.account) == ("anna", site.anna.account)
    entries = [each for each in site.anna.pages("/accounts/me/audit") if each["event"] == "camera-consent-set"]
    assert [(each["outcome"], each["target"], each["data"]["cameras"]) for each in entries] == [
        ("done", site.robot.device, []),
        ("done", site.robot.device, ["front"]),
    ]
    assert {each["actor"] for each in entries} == {"anna"}


def test_only_the_owner_may_decide(site: Site) -> None:
    bert = site.cloud.sign_in("bert")
    problem(site.decide("front", person=bert), 404, "device-unknown")
    for role in ("operator", "viewer"):
        site.anna.post(f"/devices/{site.robot.device}/shares", {"account": "bert", "role": role})
        body = problem(site.decide("front", person=bert), 403, "forbidden")
        assert "owner" in body["detail"]
        assert bert.get(site.path).json()["cameras"] == []
    assert site.sent() == []


def test_an_api_key_cannot_consent(site: Site) -> None:
    created = site.anna.post("/api-keys", {"name": "program", "role": "operator"}).json()
    headers = {"Authorization": f"Bearer {created['token']}"}
    answer = site.cloud.request("PUT", f"/api/v1{site.path}", headers=headers, json={"cameras": ["front"]})
    assert "API keys" in problem(answer, 403, "forbidden")["detail"]
    assert site.sent() == []


@pytest.mark.parametrize("camera", ["rear", "depth"])
def test_a_camera_that_cannot_be_recorded_is_named(site: Site, camera: str) -> None:
    body = problem(site.decide(camera), 422, "invalid")
    assert body["detail"] == f"No camera '{camera}' of this device can be recorded; it has: front, wrist."
    site.robot.publish(
        site.robot.topic(topics.DESC),
        Description(device="arm", kind="robot", robot_type="ur5", label="Arm"),
        retain=True,
    )
    site.cloud.settle()
    assert problem(site.decide("front"), 422, "invalid")["detail"].endswith("it has: none.")


def test_a_device_that_has_not_described_itself_has_no_cameras(cloud: Cloud) -> None:
    with paired(cloud) as (anna, robot):
        answer = anna.put(f"/devices/{robot.device}/camera-consent", {"cameras": ["front"], "wait_ms": 0})
        assert problem(answer, 422, "invalid")["detail"].endswith("it has: none.")


def test_an_agent_without_this_request_is_named(site: Site) -> None:
    message = Presence(online=True, session=9, at_ms=site.cloud.clock.now_ms(), capabilities=("say",))
    site.robot.publish(topics.conn(site.robot.space, site.robot.id), message, retain=True)
    site.cloud.settle()
    assert "Update the agent" in problem(site.decide("front"), 422, "unable")["detail"]


def test_a_withdrawal_reaches_a_device_that_was_offline(site: Site) -> None:
    site.decide("front")
    site.report(1)
    assert site.anna.get(site.path).json()["confirmed"]
    site.robot.silent = True
    site.robot.commands.clear()
    assert not site.decide().json()["confirmed"]
    site.robot.commands.clear()  # as if it had not arrived
    assert not site.anna.get(site.path).json()["confirmed"]
    site.report(1)
    assert site.sent() == [((), 2)]
    site.report(2)
    assert site.sent() == [((), 2)]
    assert site.anna.get(site.path).json()["confirmed"]


def test_a_decision_is_stored_although_the_broker_is_unreachable(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    async def fail(*_: Any, **__: Any) -> None:
        raise BusUnavailable("the broker does not respond")

    with monkeypatch.context() as lost:
        lost.setattr(Delivery, "send_confirmed", fail)
        answer = site.decide("front")
    assert (answer.status_code, answer.json()["confirmed"]) == (200, False)
    site.report(0)
    assert site.sent() == [(("front",), 1)]


def test_the_devices_reason_is_returned(site: Site) -> None:
    robot = site.robot

    def handle(command: Command) -> None:
        robot.report(command.id, AckStatus.FAILED, reason=Reason(code="journal", message="the disk is full"))

    robot.silent = True
    request = site.anna.begin("PUT", site.path, json={"cameras": ["front"], "wait_ms": 1_000})
    handle(robot.received(SetCameraConsent)[-1])
    assert request().json()["reason"] == {"code": "journal", "message": "the disk is full"}


def test_after_a_restored_backup_a_decision_has_a_number_that_the_device_accepts(site: Site) -> None:
    site.report(7)
    site.decide("front")
    assert site.sent() == [(("front",), 8)]


def test_a_decision_ends_with_the_owner_and_the_room(site: Site) -> None:
    site.decide("front")
    site.anna.post("/spaces", {"name": "other"})
    spaces = site.anna.get("/spaces").json()["items"]
    other = next(each["id"] for each in spaces if each["id"] != site.robot.space)
    moved = site.anna.put(f"/agents/{site.robot.id}/space", {"space": other})
    assert moved.status_code < 300, moved.text
    assert site.anna.get(site.path).json()["cameras"] == []
