"""Operators over XMPP have the same rights, leases and epochs as over HTTP and MQTT."""

import json
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from device_agent.protocol import JointTarget, RunMovement, Setpoint, codec, topics
from device_agent.protocol.security import setpoints
from device_agent.protocol.xmpp import operator_stanzas, stanzas
from function_app.entrypoints.xmpp import operators
from tests.harness.cloud.cloud import Person
from tests.harness.network.brokers import wait_until
from tests.harness.network.xmpp import XmppRobot, XmppSite
from tests.harness.network.xmpp_operator import XmppOperator

TELEMETRY = b'{"sequence":1,"at_ms":1,"tick_ms":1,"position_rad":[0.1],"commanded_rad":[0.1],"mode":"idle"}'


@pytest.fixture
def operator(site: XmppSite, anna: Person) -> Iterator[XmppOperator]:
    with XmppOperator(site.prosody.port, anna) as operator:
        assert operator.sign_in().status == 204
        yield operator


def sealed(lease: dict[str, Any], topic: str, sequence: int = 1) -> bytes:
    setpoint = Setpoint(
        epoch=lease["epoch"],
        sequence=sequence,
        echo_tick_ms=1,
        sent_ms=1.0,
        target=JointTarget(position_rad={"elbow": 0.1}),
    )
    return setpoints.seal(codec.encode(setpoint), bytes.fromhex(lease["setpoint_key"]), topic)


def test_an_operator_takes_control_and_streams_setpoints(robot: XmppRobot, operator: XmppOperator) -> None:
    status, devices = operator.call("GET", "/devices")
    assert status == 200
    (device,) = [each for each in devices["items"] if each["id"] == robot.device]
    status, lease = operator.call("POST", f"/devices/{robot.device}/lease", {"lease_ms": 10_000, "wait_ms": 10_000})
    assert (status, lease["confirmed"]) == (200, True)
    topic = f"{device['topic']}/ctl/{lease['epoch']}"
    for sequence in (1, 2, 3):
        operator.publish(topic, sealed(lease, topic, sequence))
    wait_until(lambda: robot.setpoints, "a setpoint at the robot")
    assert {each for each, _ in robot.setpoints} == {topic}
    wait_until(lambda: robot.setpoints[-1][1] == sealed(lease, topic, 3), "the newest setpoint")
    assert operator.rejections() == []


def test_an_action_has_the_same_result_as_over_http(robot: XmppRobot, anna: Person, operator: XmppOperator) -> None:
    request = {"kind": "run_movement", "name": "wave"}
    status, action = operator.call("POST", f"/devices/{robot.device}/actions", {"request": request})
    assert status in (200, 201, 202), action
    wait_until(lambda: robot.received(RunMovement), "the movement")
    assert anna.action(action["id"])["id"] == action["id"]


def test_an_operator_receives_only_the_topics_of_visible_devices(
    site: XmppSite, robot: XmppRobot, operator: XmppOperator
) -> None:
    joints = f"{robot.topic(topics.TELE)}/joints"
    with site.robot() as other:
        other.pair(site.cloud.sign_in("bert"))
        refused = operator.listen(joints, f"{other.topic(topics.TELE)}/joints")
        assert refused.status == 403
        assert "may not receive" in json.loads(refused.body)["detail"]
    assert operator.listen("ts/v1/#").status == 403
    assert operator.listen(joints, robot.topic(topics.STATE)).status == 204

    def arrived() -> bool:
        robot.link.transport.publish(joints, TELEMETRY, qos=0)  # type: ignore[union-attr]
        return bool(operator.received(joints))

    wait_until(arrived, "telemetry")
    assert operator.received(joints)[0] == TELEMETRY


def test_setpoints_without_a_lease_reach_no_robot(robot: XmppRobot, operator: XmppOperator) -> None:
    topic = f"{robot.topic(topics.CTL)}/1"
    operator.publish(topic, sealed({"epoch": 1, "setpoint_key": "00" * 32}, topic))
    wait_until(operator.rejections, "a rejection")
    assert robot.setpoints == []


def test_a_viewer_cannot_act_and_a_stranger_sees_nothing(site: XmppSite, robot: XmppRobot, anna: Person) -> None:
    victor, bert = site.cloud.sign_in("victor"), site.cloud.sign_in("bert")
    share = {"account": victor.name, "role": "viewer"}
    assert anna.post(f"/spaces/{robot.space}/shares", share).status_code == 201
    with XmppOperator(site.prosody.port, victor) as viewer, XmppOperator(site.prosody.port, bert) as stranger:
        for person, expected in ((viewer, 403), (stranger, 404)):
            assert person.sign_in().status == 204
            status, problem = person.call("POST", f"/devices/{robot.device}/lease", {"lease_ms": 5000})
            assert status == expected, problem
            topic = f"{robot.topic(topics.CTL)}/1"
            person.publish(topic, sealed({"epoch": 1, "setpoint_key": "00" * 32}, topic))
            wait_until(person.rejections, "a rejection")
    assert robot.setpoints == []


def test_calls_need_a_sign_in_with_a_token_of_the_same_account(site: XmppSite, robot: XmppRobot, anna: Person) -> None:
    with XmppOperator(site.prosody.port, anna, token=site.cloud.sign_in("bert").token) as foreign:
        assert foreign.call("GET", "/devices")[0] == 401
        assert foreign.sign_in().status == 403
        assert foreign.call("GET", "/devices")[0] == 401
        foreign.publish(f"{robot.topic(topics.CTL)}/1", b"{}")
    with XmppOperator(site.prosody.port, anna, token="wrong") as wrong:
        assert wrong.sign_in().status == 401
    carl = site.cloud.sign_in("carl")
    with XmppOperator(site.prosody.port, carl) as operator:
        assert operator.sign_in().status == 204
        assert carl.post("/auth/sign-out").status_code == 204
        wait_until(lambda: operator.call("GET", "/devices")[0] == 401, "the end of the session")
    assert robot.setpoints == []


def test_sign_in_and_other_content_than_json_stay_on_http(operator: XmppOperator) -> None:
    for path in ("/auth/sign-in", "/xmpp/verify", "/xmpp/credentials"):
        assert operator.call("POST", path, {})[0] == 404, path
    assert operator.call("GET", "/nothing")[0] == 404


MALFORMED = [
    "<call xmlns='urn:telescope:v1' method='BREW' path='/api/v1/devices'/>",
    "<call xmlns='urn:telescope:v1' method='GET' path='http://elsewhere/'/>",
    "<call xmlns='urn:telescope:v1' method='GET' path='/api/v1/devices'/><sign-in xmlns='urn:telescope:v1'/>",
    "<listen xmlns='urn:telescope:v1'>" + "<topic>a</topic>" * 65 + "</listen>",
    "<listen xmlns='urn:telescope:v1'><topic/></listen>",
    "<m xmlns='urn:telescope:v1' topic='ts/v1/a/b/c/ctl/x'>{}</m>",
    "<m xmlns='urn:telescope:v1' topic='elsewhere'>{}</m>",
]


@pytest.mark.parametrize("content", MALFORMED)
def test_a_malformed_stanza_is_rejected(operator: XmppOperator, content: str) -> None:
    operator.send(f"<message to='{operator.cloud}' id='bad'>{content}</message>")
    wait_until(operator.rejections, "a rejection")
    assert operator.call("GET", "/devices")[0] == 200


def test_a_disconnected_operator_leaves_no_broker_connection(site: XmppSite, anna: Person) -> None:
    gateway = site.gateways[0].gateway
    with XmppOperator(site.prosody.port, anna) as operator:
        assert operator.sign_in().status == 204
        assert len(gateway._operators._sessions) == 1
    wait_until(lambda: not gateway._operators._sessions, "the end of the session")


def test_the_number_of_sessions_is_limited_for_an_account_and_in_total(
    site: XmppSite, anna: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    sessions = site.gateways[0].gateway._operators._sessions
    wait_until(lambda: not sessions, "the end of earlier sessions")
    monkeypatch.setattr(operators, "MAX_OF_ACCOUNT", 1)
    monkeypatch.setattr(operators, "MAX_SESSIONS", 1)
    with (
        XmppOperator(site.prosody.port, anna, resource="first") as first,
        XmppOperator(site.prosody.port, anna, resource="second") as second,
    ):
        assert first.sign_in().status == 204
        assert second.sign_in().status == 204
        assert first.call("GET", "/devices")[0] == 401
        topic = "ts/v1/space/agent/device/ctl/1"
        first.publish(topic, sealed({"epoch": 1, "setpoint_key": "00" * 32}, topic))
        wait_until(first.rejections, "a rejection of the ended session's setpoint")
        with XmppOperator(site.prosody.port, site.cloud.sign_in("bert")) as other:
            assert other.sign_in().status == 503
        assert second.call("GET", "/devices")[0] == 200


def test_requests_and_answers_are_parsed_as_written() -> None:
    for stanza, expected in (
        (operator_stanzas.sign_in("a@b/c", "1", "t"), operator_stanzas.SignIn("1", "t")),
        (
            operator_stanzas.call("a@b/c", "2", "POST", "/api/v1/x?y=1", '{"a": "<&>"}'),
            operator_stanzas.Call("2", "POST", "/api/v1/x?y=1", b'{"a": "<&>"}'),
        ),
        (operator_stanzas.listen("a@b/c", "3", ("x/y", "z")), operator_stanzas.Listen("3", ("x/y", "z"))),
    ):
        assert operator_stanzas.parse_request(element(stanza)) == expected
    answer = element(operator_stanzas.answer("a@b/c", "4", 200, "{}\x00"))
    assert operator_stanzas.parse_answer(answer) == operator_stanzas.Answer("4", 200, b"{}")
    assert operator_stanzas.parse_answer(element(stanzas.receipt("a@b/c", "4"))) is None


def element(text: str) -> Any:
    return ET.fromstring(text.replace("<message ", "<message xmlns='jabber:client' ", 1))  # noqa: S314
