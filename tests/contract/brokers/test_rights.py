"""Default deny: clients may only publish and receive what their grant names."""

import pytest

from device_agent.protocol.security import grants
from function_app.ports.broker_access import Credentials
from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import SILENCE_S, Client, Message, RunningBroker, Transport, wait_until
from tests.harness.network.raw_mqtt import RawConnection


def echo(broker: RunningBroker, space: str, *filters: str) -> tuple[Client, Client]:
    """A subscriber of ``filters`` and a marker topic, and a publisher of the marker."""
    mark = f"ts/v1/{space}/mark/conn"
    ear = broker.client(f"{space}-ear", subscribe=(*filters, mark))
    assert ear.subscribe(*filters, mark) == [1] * (len(filters) + 1)
    return ear, broker.client(f"{space}-mark", publish=(mark,))


def heard_before_mark(ear: Client, marker: Client, space: str) -> list[Message]:
    marker.publish_acknowledged(f"ts/v1/{space}/mark/conn", b"mark")
    found = []
    while (message := ear.receive()).payload != b"mark":
        found.append(message)
    return found


def test_connecting_without_credentials_fails(broker: RunningBroker, space: str, transport: Transport) -> None:
    with broker.connect(space, None, transport=transport) as stranger:
        assert stranger.answer_code not in (None, 0)
        assert not stranger.connected.is_set()


def test_connecting_with_a_wrong_password_fails(broker: RunningBroker, space: str) -> None:
    right = broker.issue(broker.grant(space))
    for password in ("", "wrong", right.password[:-4], right.password[1:]):
        with broker.connect(space, Credentials(right.username, password)) as stranger:
            assert not stranger.connected.is_set()


def test_connecting_with_another_user_name_fails(broker: RunningBroker, space: str) -> None:
    right = broker.issue(broker.grant(space))
    with broker.connect(space, Credentials(f"{right.username}x", right.password)) as stranger:
        assert not stranger.connected.is_set()


def test_credentials_are_bound_to_their_client_id(broker: RunningBroker, space: str) -> None:
    credentials = broker.issue(broker.grant(space))
    with broker.connect(f"{space}-other", credentials) as thief:
        assert not thief.connected.is_set()


def test_a_client_without_rights_receives_nothing(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    with broker.client(f"{space}-arm", publish=(topic,)) as arm, broker.client(f"{space}-deaf") as deaf:
        arm.publish_acknowledged(topic, b"retained", retain=True)
        deaf.subscribe(topic, "ts/v1/#", "#", "+/+/+/+/+")
        ear, marker = echo(broker, space, topic)
        with ear, marker:
            arm.publish_acknowledged(topic, b"live")
            assert [m.payload for m in heard_before_mark(ear, marker, space)] == [b"retained", b"live"]
            assert deaf.pending() == []


def test_a_client_without_rights_cannot_publish(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    ear, marker = echo(broker, space, topic)
    with ear, marker:
        for qos in (0, 1):
            with broker.client(f"{space}-mute") as mute:
                mute.publish(topic, b"smuggled", qos=qos, retain=True)

                assert heard_before_mark(ear, marker, space) == []
    with broker.client(f"{space}-late", subscribe=(topic,)) as late:
        late.subscribe(topic)
        with pytest.raises(AssertionError, match="received nothing"):
            late.receive(SILENCE_S)


@pytest.mark.parametrize(
    "wider", ["#", "ts/#", "ts/v1/#", "ts/v1/{space}/#", "ts/v1/{space}/+/arm/state", "+/+/+/+/+/+"]
)
def test_a_wildcard_beyond_the_grant_receives_nothing_else(broker: RunningBroker, space: str, wider: str) -> None:
    mine, other = f"ts/v1/{space}/mine/arm/state", f"ts/v1/{space}/other/arm/state"
    with (
        broker.client(f"{space}-agents", publish=(mine, other)) as agents,
        broker.client(f"{space}-nosy", subscribe=(mine,)) as nosy,
    ):
        agents.publish_acknowledged(other, b"retained", retain=True)
        nosy.subscribe(wider.format(space=space))
        nosy.subscribe(mine)
        agents.publish_acknowledged(other, b"live")
        agents.publish_acknowledged(mine, b"end")
        assert [m.topic for m in (nosy.receive(), *nosy.pending())] == [mine]


def test_a_wildcard_inside_the_grant_is_granted(broker: RunningBroker, space: str) -> None:
    agent = f"ts/v1/{space}/arm/+/tele/+"
    with (
        broker.client(f"{space}-arm", publish=(agent,)) as arm,
        broker.client(f"{space}-page", subscribe=(agent,)) as page,
    ):
        assert page.subscribe(f"ts/v1/{space}/arm/ur5/tele/+", f"ts/v1/{space}/arm/cell/tele/joints") == [1, 1]
        arm.publish_acknowledged(f"ts/v1/{space}/arm/ur5/tele/joints", b"1")
        arm.publish_acknowledged(f"ts/v1/{space}/arm/cell/tele/joints", b"2")
        assert [page.receive().payload, page.receive().payload] == [b"1", b"2"]


def agent_of(broker: RunningBroker, space: str, agent: str) -> Credentials:
    return broker.issue(grants.agent_grant(space, agent, token_id=f"{space}-{agent}", lifetime_s=300))


def test_an_agent_cannot_publish_for_another(broker: RunningBroker, space: str) -> None:
    victim = [
        f"ts/v1/{space}/victim/{rest}" for rest in ("conn", "arm/desc", "arm/state", "arm/tele/joints", "arm/ack")
    ]
    ear, marker = echo(broker, space, *victim)
    with ear, marker:
        for topic in victim:
            credentials = broker.issue(
                grants.agent_grant(space, "evil", token_id=f"{space}{hash(topic)}", lifetime_s=60)
            )
            with broker.connect("evil", credentials) as evil:
                evil.publish(topic, b"lie", retain=True)
                wait_until(lambda: evil.disconnected.is_set() or broker.kind == "mosquitto", "the end")
        assert heard_before_mark(ear, marker, space) == []


def test_an_agent_cannot_receive_commands_of_another(broker: RunningBroker, space: str) -> None:
    order = f"ts/v1/{space}/victim/arm/cmd"
    ear, marker = echo(broker, space, order)
    with ear, marker, broker.connect("evil", agent_of(broker, space, "evil")) as evil, broker.service() as functions:
        for topic in (order, f"ts/v1/{space}/+/arm/cmd", f"ts/v1/{space}/victim/+/ctl/+", f"ts/v1/{space}/victim/#"):
            evil.subscribe(topic)
        functions.publish_acknowledged(order, b"move")
        assert [m.payload for m in heard_before_mark(ear, marker, space)] == [b"move"]
        assert evil.pending() == []


def test_an_agent_cannot_receive_retained_messages_of_another(broker: RunningBroker, space: str) -> None:
    state = f"ts/v1/{space}/victim/arm/state"
    own = f"ts/v1/{space}/evil/arm/cmd"
    with (
        broker.connect("victim", agent_of(broker, space, "victim")) as victim,
        broker.connect("evil", agent_of(broker, space, "evil")) as evil,
        broker.service() as functions,
    ):
        victim.publish_acknowledged(state, b"secret", retain=True)
        evil.subscribe(state, f"ts/v1/{space}/victim/#", own)
        functions.publish_acknowledged(own, b"end")
        assert [m.topic for m in (evil.receive(), *evil.pending())] == [own]


def test_an_agent_only_receives_telemetry_of_its_space(broker: RunningBroker, space: str) -> None:
    measured = f"ts/v1/{space}/sensors/pir/tele/presence"
    kinds = ("late/presence", "cam/room", "event", "ack", "cmd", "ctl/1", "stop", "desc", "state")
    others = [f"ts/v1/{space}/sensors/pir/{kind}" for kind in kinds]
    others.append(f"ts/v1/{space}-elsewhere/sensors/pir/tele/presence")
    with (
        broker.client(f"{space}-speaker", publish=(*others, measured)) as speaker,
        broker.connect("robot", agent_of(broker, space, "robot")) as robot,
    ):
        for topic in (measured, *others):
            robot.subscribe(topic)
        for topic in (*others, measured):
            speaker.publish_acknowledged(topic, b"1")
        assert [m.topic for m in (robot.receive(), *robot.pending())] == [measured]


def test_a_will_outside_the_grant_is_not_published(broker: RunningBroker, space: str) -> None:
    conn = f"ts/v1/{space}/victim/conn"
    ear, marker = echo(broker, space, conn)
    with ear, marker:
        evil = broker.connect("evil", agent_of(broker, space, "evil"), will=Message(conn, b"offline", 1, retain=True))
        if evil.connected.is_set():
            evil.vanish()
            wait_until(evil.disconnected.is_set, "the end of the connection")
        evil.close()
        assert heard_before_mark(ear, marker, space) == []
    with broker.client(f"{space}-late", subscribe=(conn,)) as late:
        late.subscribe(conn)
        with pytest.raises(AssertionError, match="received nothing"):
            late.receive(SILENCE_S)


def test_the_epoch_in_the_topic_fences_a_former_holder(broker: RunningBroker, space: str) -> None:
    device = f"ts/v1/{space}/arm/ur5"
    ear, marker = echo(broker, space, f"{device}/ctl/+")
    with ear, marker:
        for epoch in ("6", "50", "4", "5x"):
            with broker.client(f"{space}-former", publish=(f"{device}/ctl/5", f"{device}/stop")) as former:
                former.publish(f"{device}/ctl/{epoch}", b"too late", qos=0)
                assert heard_before_mark(ear, marker, space) == []
        with broker.client(f"{space}-former", publish=(f"{device}/ctl/5",)) as holder:
            holder.publish_acknowledged(f"{device}/ctl/5", b"in time")
        assert [m.payload for m in heard_before_mark(ear, marker, space)] == [b"in time"]


@pytest.mark.parametrize(
    "pattern", ["$SYS/#", "$CONTROL/#", "$share/group/ts/v1/#", "$share/group/ts/v1/{space}/arm/conn"]
)
def test_dollar_topics_are_invisible(broker: RunningBroker, space: str, pattern: str) -> None:
    topic, own = f"ts/v1/{space}/arm/conn", f"ts/v1/{space}/nosy/conn"
    with (
        broker.client(f"{space}-arm", publish=(topic, own)) as arm,
        broker.client(f"{space}-nosy", subscribe=(own,)) as nosy,
    ):
        nosy.subscribe(pattern.format(space=space))
        nosy.subscribe(own)
        broker.revoke(client_id="unknown")
        arm.publish_acknowledged(topic, b"x")
        arm.publish_acknowledged(own, b"end")
        assert [m.topic for m in (nosy.receive(), *nosy.pending())] == [own]


@pytest.mark.parametrize("topic", ["$CONTROL/telescope/v1", "$CONTROL/dynamic-security/v1", "$SYS/broker/uptime"])
def test_only_the_functions_may_use_the_control_topic(broker: RunningBroker, space: str, topic: str) -> None:
    with broker.client(f"{space}-victim") as victim, broker.client(f"{space}-evil", publish=("#", "+/+/+")) as evil:
        for order in (
            b'{"revoke":{"client_id":"%s-victim"}}' % space.encode(),
            b'{"commands":[{"command":"listClients"},{"command":"createClient","username":"x","password":"x"}]}',
        ):
            evil.publish(topic, order)
        with broker.connect("x", Credentials("x", "x")) as made:
            assert not made.connected.is_set()
        assert not victim.disconnected.wait(SILENCE_S)


def test_a_topic_with_wildcards_cannot_be_published(broker: RunningBroker, space: str) -> None:
    ear, marker = echo(broker, space, f"ts/v1/{space}/arm/ur5/tele/+")
    credentials = broker.issue(broker.grant(f"{space}-arm", publish=(f"ts/v1/{space}/arm/+/tele/+",)))
    with ear, marker:
        for name in ("+", "#", "a+", "jo\0ints"):
            with RawConnection(broker.tcp_port) as raw:
                raw.send(raw_mqtt.connect_packet(f"{space}-arm", credentials))
                assert raw.read() == (raw_mqtt.CONNACK, 0, b"\0\0")
                raw.send(raw_mqtt.publish_packet(f"ts/v1/{space}/arm/ur5/tele/{name}", b"x"))
                assert raw.closed()
        assert heard_before_mark(ear, marker, space) == []


def test_the_functions_receive_from_agents_and_command_devices(broker: RunningBroker, space: str) -> None:
    own = f"ts/v1/{space}/arm"
    said = [
        f"{own}/conn",
        *(f"{own}/ur5/{kind}" for kind in ("desc", "desc/twin", "state", "event", "ack", "tele/joints")),
    ]
    with (
        broker.connect("arm", agent_of(broker, space, "arm")) as arm,
        broker.service() as functions,
    ):
        assert functions.subscribe(*grants.SERVICE_SUBSCRIBE) == [1] * len(grants.SERVICE_SUBSCRIBE)
        assert arm.subscribe(f"{own}/+/cmd", f"{own}/+/stop") == [1, 1]
        for topic in said:
            arm.publish_acknowledged(topic, b"x")
        mine: list[str] = []
        while len(mine) < len(said):
            topic = functions.receive().topic
            mine += [topic] if f"/{space}/" in topic else []
        assert mine == said
        functions.publish_acknowledged(f"{own}/ur5/cmd", b"move")
        functions.publish_acknowledged(f"{own}/ur5/stop", b"stop")
        assert [arm.receive().payload, arm.receive().payload] == [b"move", b"stop"]


def test_the_functions_may_forward_messages_of_http_agents(broker: RunningBroker, space: str) -> None:
    own = f"ts/v1/{space}/arm"
    kept = [f"{own}/conn", *(f"{own}/ur5/{kind}" for kind in ("desc", "desc/twin", "state"))]
    passed = [f"{own}/ur5/{kind}" for kind in ("event", "ack", "tele/joints")]
    with (
        broker.client(f"{space}-page", subscribe=(f"{own}/#",)) as page,
        broker.service() as functions,
    ):
        page.subscribe(*kept, *passed)
        for topic in kept:
            functions.publish_acknowledged(topic, b"now", retain=True)
        for topic in passed:
            functions.publish_acknowledged(topic, b"now")
        assert [page.receive().topic for _ in (*kept, *passed)] == [*kept, *passed]
    with broker.client(f"{space}-late", subscribe=(f"{own}/#",)) as late:
        late.subscribe(*kept)
        found = {message.topic: message.retain for message in (late.receive() for _ in kept)}
        assert found == dict.fromkeys(kept, True)


def test_the_functions_cannot_publish_setpoints_or_frames(broker: RunningBroker, space: str) -> None:
    own = f"ts/v1/{space}/arm"
    ear, marker = echo(broker, space, f"{own}/ur5/ctl/+", f"{own}/ur5/cam/+")
    with ear, marker:
        for topic in (f"{own}/ur5/ctl/1", f"{own}/ur5/cam/wrist"):
            with broker.service() as functions:
                functions.subscribe(f"{own}/ur5/ctl/+", f"{own}/ur5/cam/+")
                functions.publish(topic, b"x")
                assert heard_before_mark(ear, marker, space) == []
                assert functions.pending() == []
