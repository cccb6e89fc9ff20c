"""An agent over XMPP has the same functions as one over MQTT."""

import time

from device_agent.protocol import AckStatus, JointTarget, Setpoint, Stop, codec, topics
from device_agent.protocol.security import setpoints
from function_app.services.storage import records
from tests.harness.cloud.cloud import Person
from tests.harness.network.brokers import RunningBroker, wait_until
from tests.harness.network.xmpp import XmppRobot, XmppSite

ODD = 'grüß 🤖 " \\ \n <&> \uffff'


def test_a_command_is_delivered_on_connect_and_repeated_with_the_same_bytes_until_it_is_acknowledged(
    site: XmppSite, anna: Person
) -> None:
    with site.robot() as robot:
        robot.pair(anna)
        robot.silent = True
        action = anna.start(robot.device).json()["id"]
        robot.connect()
        wait_until(lambda: len(robot.payloads.get(action, ())) >= 2, "the repeated command")
        assert len(set(robot.payloads[action])) == 1
        robot.silent = False
        robot.report(action, AckStatus.DONE, result={"note": ODD})
        assert anna.action(action, wait_ms=10_000, wait_for="done")["result"] == {"note": ODD}

        def mailbox() -> list[str]:
            page = site.cloud.run(site.cloud.functions.tables.query(records.MAILBOX, robot.id, limit=1000))
            return [row.key for row in page.rows if not row.key.startswith("ack:")]

        wait_until(lambda: mailbox() == [], "an empty mailbox")


def test_setpoints_and_stop_of_a_console_reach_the_robot_over_the_broker(
    broker: RunningBroker, anna: Person, robot: XmppRobot
) -> None:
    lease = anna.take_lease(robot.device, wait_ms=10_000).json()
    request = {"purpose": "control", "device": robot.device, "epoch": lease["epoch"]}
    issued = anna.post("/mqtt/credentials", request).json()
    (topic,) = issued["publish"]
    key = bytes.fromhex(lease["setpoint_key"])
    with broker.connect(issued["client_id"], (issued["username"], issued["password"])) as console:  # type: ignore[arg-type]
        for sequence in range(1, 21):
            setpoint = Setpoint(
                epoch=lease["epoch"],
                sequence=sequence,
                echo_tick_ms=1,
                sent_ms=0.5,
                target=JointTarget(position_rad={"a": 0.1}),
            )
            console.publish(topic, setpoints.seal(codec.encode(setpoint), key, topic), qos=0)
            time.sleep(0.005)
        wait_until(lambda: len(robot.setpoints) >= 20, "every setpoint")
    assert {received for received, _ in robot.setpoints} == {topic}
    keys = (setpoints.SetpointKey(key, topic),)
    received = [setpoints.open_sealed(payload, keys) for _, payload in robot.setpoints]
    assert [codec.decode(body, Setpoint).sequence for body in received] == list(range(1, 21))
    issued = anna.post("/mqtt/credentials", {"purpose": "view"}).json()
    with broker.connect(issued["client_id"], (issued["username"], issued["password"])) as console:  # type: ignore[arg-type]
        console.publish(f"{robot.topic(topics.STOP)}/{anna.account}", codec.encode(Stop(id="s1")))
        wait_until(lambda: any(stop.id == "s1" for stop in robot.stops), "the Stop")


def test_a_robot_receives_only_subscribed_measurements_of_its_own_space(
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
        with site.watcher(broker) as publisher:
            for of in (foreign, eye):
                publisher.publish(tele(of, "motion"), b'{"of": "%s"}' % of.id.encode(), qos=0)
                publisher.publish(tele(of, "warmth"), b"{}", qos=0)
            wait_until(lambda: robot.space_messages, "the measurement")
            publisher.publish(tele(eye, "motion"), b"last", qos=0)
            wait_until(lambda: robot.space_messages[-1][1] == b"last", "the last measurement")
        assert {topic for topic, _ in robot.space_messages} == {tele(eye, "motion")}
