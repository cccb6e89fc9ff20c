"""An agent that speaks XMPP does all that one on MQTT does."""

import time

from device_agent.protocol import (
    AckStatus,
    CancelAction,
    GrantLease,
    JointTarget,
    Mode,
    MoveJoints,
    ReleaseLease,
    ResetStop,
    Setpoint,
    State,
    Stop,
    StopDevice,
    codec,
    topics,
)
from function_app.services.storage import records
from tests.harness.cloud.cloud import Person, problem
from tests.harness.network.brokers import RunningBroker, wait_until
from tests.harness.network.xmpp import XmppRobot, XmppSite

ODD = 'grüß 🤖 " \\ \n <&> \uffff'


def test_lease_action_end_stop_and_reset(anna: Person, robot: XmppRobot) -> None:
    assert anna.get(f"/devices/{robot.device}").json()["online"]
    lease = anna.take(robot.device, wait_ms=10_000).json()
    assert lease["confirmed"]
    action = anna.start(robot.device, epoch=lease["epoch"], wait_ms=10_000).json()
    assert action["status"] == "started"
    problem(anna.start(robot.device, epoch=lease["epoch"]), 409, "device-busy")
    robot.report(action["id"], AckStatus.DONE, result={"note": ODD})
    final = anna.action(action["id"], wait_ms=10_000, wait_for="done")
    assert (final["status"], final["result"]["note"]) == ("done", ODD)
    assert anna.delete(f"/devices/{robot.device}/lease?epoch={lease['epoch']}").status_code == 204
    wait_until(lambda: robot.heard(ReleaseLease), "the release")
    assert anna.post(f"/devices/{robot.device}/stop", {"reason": "look out"}).json() == {"confirmed": True}
    assert anna.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": True}
    assert robot.heard(StopDevice)
    assert robot.heard(ResetStop)
    wait_until(lambda: robot.stops, "the plain Stop as well")


def test_a_cancel_reaches_it_and_a_mailbox_is_empty_in_the_end(site: XmppSite, anna: Person, robot: XmppRobot) -> None:
    action = anna.start(robot.device, wait_ms=10_000).json()
    assert anna.post(f"/actions/{action['id']}/cancel").status_code == 202
    wait_until(lambda: robot.heard(CancelAction), "the cancel")
    robot.report(action["id"], AckStatus.CANCELLED)
    assert anna.action(action["id"], wait_ms=10_000, wait_for="done")["status"] == "cancelled"

    def letters() -> list[str]:
        page = site.cloud.run(site.cloud.functions.tables.query(records.MAILBOX, robot.id, limit=1000))
        return [row.key for row in page.rows if not row.key.startswith("ack:")]

    wait_until(lambda: letters() == [], "an empty mailbox")


def test_setpoints_and_stop_of_a_console_reach_it_over_the_broker(
    broker: RunningBroker, anna: Person, robot: XmppRobot
) -> None:
    lease = anna.take(robot.device, wait_ms=10_000).json()
    asked = {"purpose": "control", "device": robot.device, "epoch": lease["epoch"]}
    given = anna.post("/mqtt/credentials", asked).json()
    (topic,) = given["publish"]
    with broker.connect(given["client_id"], (given["username"], given["password"])) as console:  # type: ignore[arg-type]
        for sequence in range(1, 21):
            setpoint = Setpoint(
                epoch=lease["epoch"],
                sequence=sequence,
                echo_tick_ms=1,
                sent_ms=0.5,
                target=JointTarget(position_rad={"a": 0.1}),
            )
            console.publish(topic, codec.encode(setpoint), qos=0)
            time.sleep(0.005)
        wait_until(lambda: len(robot.setpoints) >= 20, "every setpoint")
    assert {found for found, _ in robot.setpoints} == {topic}
    assert [codec.decode(payload, Setpoint).sequence for _, payload in robot.setpoints] == list(range(1, 21))
    given = anna.post("/mqtt/credentials", {"purpose": "view"}).json()
    with broker.connect(given["client_id"], (given["username"], given["password"])) as console:  # type: ignore[arg-type]
        console.publish(robot.topic(topics.STOP), codec.encode(Stop(id="s1", caller="anna")))
        wait_until(lambda: any(stop.id == "s1" for stop in robot.stops), "the Stop")


def test_what_it_says_is_heard_on_the_broker_and_kept_there_where_the_contract_says_so(
    site: XmppSite, broker: RunningBroker, robot: XmppRobot
) -> None:
    with site.watcher(broker) as watcher:
        tele = topics.device(robot.space, robot.id, "arm", topics.TELE, "joints")
        watcher.subscribe(tele)
        state = State(device="arm", at_ms=1, tick_ms=1, mode=Mode.IDLE, epoch=0)
        robot.say_state(state)
        line = robot.link
        assert line is not None
        for _ in range(3):
            assert line.transport.publish(tele, b'{"not": "telemetry"}', qos=0)  # type: ignore[attr-defined]
        wait_until(lambda: watcher.messages.qsize() >= 3, "telemetry on the broker")
        watcher.pending()
        watcher.subscribe(robot.topic(topics.STATE))
        message = watcher.receive()
        assert message.retain
        assert codec.decode(message.payload, State) == state


def test_what_waits_is_brought_when_it_comes(site: XmppSite, anna: Person) -> None:
    with site.robot() as robot:
        robot.pair(anna)
        action = anna.start(robot.device).json()["id"]
        robot.connect()
        wait_until(lambda: robot.heard(MoveJoints), "the command that waited")
        assert anna.action(action, wait_ms=10_000, wait_for="started")["status"] == "started"


def test_an_answer_that_says_no_is_an_answer(anna: Person, robot: XmppRobot) -> None:
    robot.silent = True
    asking = anna.begin("POST", f"/devices/{robot.device}/lease", json={"wait_ms": 20_000})
    wait_until(lambda: robot.heard(GrantLease), "the lease")
    began = time.monotonic()
    robot.report(robot.commands[-1].id, AckStatus.FAILED)
    assert asking().json()["confirmed"] is False
    assert time.monotonic() - began < 10


def test_a_command_is_told_again_until_it_is_answered(anna: Person, robot: XmppRobot) -> None:
    robot.silent = True
    action = anna.start(robot.device).json()["id"]
    wait_until(lambda: len(robot.payloads.get(action, ())) >= 2, "the command, again")
    assert len(set(robot.payloads[action])) == 1, "the same bytes"
    robot.silent = False
    robot.report(action, AckStatus.STARTED)
    assert anna.action(action, wait_ms=10_000, wait_for="started")["status"] == "started"


def test_it_hears_what_its_space_measures_where_it_asks_for_it_and_nothing_of_another(
    site: XmppSite, broker: RunningBroker, anna: Person
) -> None:
    bert = site.cloud.sign_in("bert")
    with site.robot() as robot, site.robot() as eye, site.robot() as foreign:
        robot.pair(anna)
        eye.pair(anna)
        foreign.pair(bert)

        def tele(of: XmppRobot, stream: str) -> str:
            return topics.device(of.space, of.id, "arm", topics.TELE, stream)

        robot.listen = (tele(eye, "motion"), tele(foreign, "motion"), robot.topic(topics.STATE), "ts/v1/+/+/+/tele/+")
        robot.connect()
        with site.watcher(broker) as someone:
            for of in (foreign, eye):
                someone.publish(tele(of, "motion"), b'{"of": "%s"}' % of.id.encode(), qos=0)
                someone.publish(tele(of, "warmth"), b"{}", qos=0)
            wait_until(lambda: robot.overheard, "the measurement")
            someone.publish(tele(eye, "motion"), b"last", qos=0)
            wait_until(lambda: robot.overheard[-1][1] == b"last", "the last measurement")
        assert {topic for topic, _ in robot.overheard} == {tele(eye, "motion")}
