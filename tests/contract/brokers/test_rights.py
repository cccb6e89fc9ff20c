"""Default deny: clients may only publish and receive what their grant names."""

import contextlib
from collections.abc import Iterator

import pytest

from device_agent.protocol.security import grants
from function_app.domain.common.ids import new_id
from function_app.ports.broker_access import Credentials
from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import SILENCE_S, Client, Message, RunningBroker, Transport, wait_until


class Listener:
    """A subscriber of some filters, and a publisher of a marker that arrives after everything before it."""

    def __init__(self, subscriber: Client, publisher: Client, marker: str) -> None:
        self._subscriber, self._publisher, self._marker = subscriber, publisher, marker

    def received(self) -> list[bytes]:
        """Payloads that arrived so far."""
        self._publisher.publish_acknowledged(self._marker, b"mark")
        payloads = []
        while (message := self._subscriber.receive()).topic != self._marker:
            payloads.append(message.payload)
        return payloads


@contextlib.contextmanager
def listen(broker: RunningBroker, space: str, *filters: str) -> Iterator[Listener]:
    marker = f"ts/v1/{space}/mark/conn"
    with (
        broker.client(f"{space}-listener", subscribe=(*filters, marker)) as subscriber,
        broker.client(f"{space}-marker", publish=(marker,)) as publisher,
    ):
        assert subscriber.subscribe(*filters, marker) == [1] * (len(filters) + 1)
        yield Listener(subscriber, publisher, marker)


def agent_of(broker: RunningBroker, space: str, agent: str) -> Credentials:
    return broker.issue(grants.agent_grant(space, agent, token_id=new_id(), lifetime_s=300))


def topics_until_silence(client: Client) -> list[str]:
    """Topics of the next message and of those that arrived with it."""
    return [message.topic for message in (client.receive(), *client.pending())]


def assert_nothing_retained(broker: RunningBroker, space: str, topic: str) -> None:
    with broker.client(f"{space}-late", subscribe=(topic,)) as late:
        late.subscribe(topic)
        with pytest.raises(AssertionError, match="received nothing"):
            late.receive(SILENCE_S)


def test_only_the_right_credentials_and_client_id_connect(
    broker: RunningBroker, space: str, transport: Transport
) -> None:
    right = broker.issue(broker.grant(space))
    wrong = [Credentials(right.username, each) for each in ("", "wrong", right.password[:-4], right.password[1:])]
    for credentials in (None, *wrong, Credentials(f"{right.username}x", right.password)):
        with broker.connect(space, credentials, transport=transport) as client:
            assert client.answer_code not in (None, 0)
            assert not client.connected.is_set()
    assert not broker.accepts(f"{space}-other", right, transport=transport)
    assert broker.accepts(space, right, transport=transport)


# ---------------------------------------------------------------- topics and filters


def test_a_client_without_permissions_receives_and_publishes_nothing(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        broker.client(f"{space}-subscriber") as subscriber,
        listen(broker, space, topic) as listener,
    ):
        arm.publish_acknowledged(topic, b"retained", retain=True)
        subscriber.subscribe(topic, "ts/v1/#", "#", "+/+/+/+/+")
        arm.publish_acknowledged(topic, b"live")
        assert listener.received() == [b"retained", b"live"]
        assert subscriber.pending() == []
        arm.publish_acknowledged(topic, b"", retain=True)
        assert listener.received() == [b""]
        for qos in (0, 1):
            with broker.client(f"{space}-mute") as mute:
                mute.publish(topic, b"smuggled", qos=qos, retain=True)
                assert listener.received() == []
    assert_nothing_retained(broker, space, topic)


@pytest.mark.parametrize(
    "pattern",
    [
        "#", "ts/#", "ts/v1/#", "ts/v1/{space}/#", "ts/v1/{space}/+/arm/state", "+/+/+/+/+/+",
        "$SYS/#", "$CONTROL/#", "$share/group/ts/v1/#", "$share/group/ts/v1/{space}/other/arm/state",
    ],
)  # fmt: skip
def test_a_filter_beyond_the_grant_receives_nothing_else(broker: RunningBroker, space: str, pattern: str) -> None:
    mine, other = f"ts/v1/{space}/mine/arm/state", f"ts/v1/{space}/other/arm/state"
    with (
        broker.client(f"{space}-agents", publish=(mine, other)) as agents,
        broker.client(f"{space}-curious", subscribe=(mine,)) as curious,
    ):
        agents.publish_acknowledged(other, b"retained", retain=True)
        curious.subscribe(pattern.format(space=space))
        curious.subscribe(mine)
        broker.revoke(client_id="unknown")
        agents.publish_acknowledged(other, b"live")
        agents.publish_acknowledged(mine, b"end")
        assert topics_until_silence(curious) == [mine]


def test_a_wildcard_inside_the_grant_is_granted(broker: RunningBroker, space: str) -> None:
    agent = f"ts/v1/{space}/arm/+/tele/+"
    with (
        broker.client(f"{space}-arm", publish=(agent,)) as arm,
        broker.client(f"{space}-page", subscribe=(agent,)) as page,
    ):
        assert page.subscribe(f"ts/v1/{space}/arm/ur5/tele/+", f"ts/v1/{space}/arm/cell/tele/joints") == [1, 1]
        arm.publish_acknowledged(f"ts/v1/{space}/arm/ur5/tele/joints", b"1")
        arm.publish_acknowledged(f"ts/v1/{space}/arm/cell/tele/joints", b"2")
        assert page.payloads(2) == [b"1", b"2"]


def test_a_topic_with_wildcards_cannot_be_published(broker: RunningBroker, space: str) -> None:
    credentials = broker.issue(broker.grant(f"{space}-arm", publish=(f"ts/v1/{space}/arm/+/tele/+",)))
    with listen(broker, space, f"ts/v1/{space}/arm/ur5/tele/+") as listener:
        for name in ("+", "#", "a+", "jo\0ints"):
            with raw_mqtt.open_session(broker, f"{space}-arm", credentials) as raw:
                raw.send(raw_mqtt.publish_packet(f"ts/v1/{space}/arm/ur5/tele/{name}", b"x"))
                assert raw.closed()
        assert listener.received() == []


def test_the_epoch_in_the_topic_fences_a_former_holder(broker: RunningBroker, space: str) -> None:
    device = f"ts/v1/{space}/arm/ur5"
    with listen(broker, space, f"{device}/ctl/+") as listener:
        for epoch in ("6", "50", "4", "5x"):
            with broker.client(f"{space}-former", publish=(f"{device}/ctl/5", f"{device}/stop/account")) as former:
                former.publish(f"{device}/ctl/{epoch}", b"too late", qos=0)
                assert listener.received() == []
        with broker.client(f"{space}-former", publish=(f"{device}/ctl/5",)) as holder:
            holder.publish_acknowledged(f"{device}/ctl/5", b"in time")
        assert listener.received() == [b"in time"]


# ---------------------------------------------------------------- agents


def test_an_agent_cannot_publish_for_another(broker: RunningBroker, space: str) -> None:
    names = ("conn", "arm/desc", "arm/state", "arm/tele/joints", "arm/ack")
    topics = [f"ts/v1/{space}/victim/{name}" for name in names]
    with listen(broker, space, *topics) as listener:
        for topic in topics:
            with broker.connect("evil", agent_of(broker, space, "evil")) as evil:
                evil.publish(topic, b"lie", retain=True)
                wait_until(lambda: evil.disconnected.is_set() or broker.kind == "mosquitto", "the end")
        will = Message(topics[0], b"offline", 1, retain=True)
        with broker.connect("evil", agent_of(broker, space, "evil"), will=will) as evil:
            if evil.connected.is_set():
                evil.vanish()
                assert evil.ended()
        assert listener.received() == []
    for topic in topics:
        assert_nothing_retained(broker, space, topic)


def test_an_agent_cannot_receive_messages_to_or_of_another(broker: RunningBroker, space: str) -> None:
    command, state = f"ts/v1/{space}/victim/arm/cmd", f"ts/v1/{space}/victim/arm/state"
    own = f"ts/v1/{space}/evil/arm/cmd"
    with (
        listen(broker, space, command) as listener,
        broker.connect("victim", agent_of(broker, space, "victim")) as victim,
        broker.connect("evil", agent_of(broker, space, "evil")) as evil,
        broker.service() as functions,
    ):
        victim.publish_acknowledged(state, b"secret", retain=True)
        for topic in (command, state, f"ts/v1/{space}/+/arm/cmd", f"ts/v1/{space}/victim/+/ctl/+"):
            evil.subscribe(topic)
        evil.subscribe(state, f"ts/v1/{space}/victim/#", own)
        functions.publish_acknowledged(command, b"move")
        functions.publish_acknowledged(own, b"end")
        assert listener.received() == [b"move"]
        assert topics_until_silence(evil) == [own]


def test_only_the_functions_confirm_and_only_to_the_agent_itself(broker: RunningBroker, space: str) -> None:
    own, other = f"ts/v1/{space}/arm/ur5/stored", f"ts/v1/{space}/evil/ur5/stored"
    with listen(broker, space, own, other) as listener, broker.service() as functions:
        for name in ("arm", "evil"):
            for topic in (own, other):
                with broker.connect(name, agent_of(broker, space, name)) as agent:
                    agent.publish(topic, b"forged")
                    wait_until(lambda: agent.disconnected.is_set() or broker.kind == "mosquitto", "the end")
        with (
            broker.connect("arm", agent_of(broker, space, "arm")) as arm,
            broker.connect("evil", agent_of(broker, space, "evil")) as evil,
        ):
            evil.subscribe(own, f"ts/v1/{space}/+/+/stored")
            assert arm.subscribe(grants.agent_confirmations(space, "arm")) == [1]
            assert evil.subscribe(grants.agent_confirmations(space, "evil")) == [1]
            functions.publish(own, b"stored", qos=0)
            functions.publish_acknowledged(other, b"end")
            assert arm.receive().payload == b"stored"
            assert topics_until_silence(evil) == [other]
        assert listener.received() == [b"stored", b"end"]


def test_an_agent_only_receives_telemetry_of_its_space(broker: RunningBroker, space: str) -> None:
    measured = f"ts/v1/{space}/sensors/pir/tele/presence"
    kinds = ("late/presence", "cam/room", "event", "ack", "cmd", "ctl/1", "stop", "desc", "state")
    others = [f"ts/v1/{space}/sensors/pir/{kind}" for kind in kinds]
    others.append(f"ts/v1/{space}-elsewhere/sensors/pir/tele/presence")
    with (
        broker.client(f"{space}-sensors", publish=(*others, measured)) as sensors,
        broker.connect("robot", agent_of(broker, space, "robot")) as robot,
    ):
        for topic in (measured, *others):
            robot.subscribe(topic)
        for topic in (*others, measured):
            sensors.publish_acknowledged(topic, b"1")
        assert topics_until_silence(robot) == [measured]


# ---------------------------------------------------------------- the functions


@pytest.mark.parametrize("topic", ["$CONTROL/telescope/v1", "$CONTROL/dynamic-security/v1", "$SYS/broker/uptime"])
def test_only_the_functions_may_use_the_control_topic(broker: RunningBroker, space: str, topic: str) -> None:
    with broker.client(f"{space}-victim") as victim, broker.client(f"{space}-evil", publish=("#", "+/+/+")) as evil:
        for message in (
            b'{"revoke":{"client_id":"%s-victim"}}' % space.encode(),
            b'{"commands":[{"command":"listClients"},{"command":"createClient","username":"x","password":"x"}]}',
        ):
            evil.publish(topic, message)
        assert not broker.accepts("x", Credentials("x", "x"))
        assert not victim.disconnected.wait(SILENCE_S)


def test_the_functions_receive_from_agents_and_command_devices(broker: RunningBroker, space: str) -> None:
    own = f"ts/v1/{space}/arm"
    kinds = ("desc", "desc/twin", "state", "event", "ack", "tele/joints")
    published = [f"{own}/conn", *(f"{own}/ur5/{kind}" for kind in kinds)]
    with broker.connect("arm", agent_of(broker, space, "arm")) as arm, broker.service() as functions:
        assert functions.subscribe(*grants.SERVICE_SUBSCRIBE) == [1] * len(grants.SERVICE_SUBSCRIBE)
        assert arm.subscribe(f"{own}/+/cmd", f"{own}/+/stop/+") == [1, 1]
        for topic in published:
            arm.publish_acknowledged(topic, b"x")
        received: list[str] = []
        while len(received) < len(published):
            topic = functions.receive().topic
            received += [topic] if f"/{space}/" in topic else []
        assert received == published
        functions.publish_acknowledged(f"{own}/ur5/cmd", b"move")
        functions.publish_acknowledged(f"{own}/ur5/stop/account", b"stop")
        assert arm.payloads(2) == [b"move", b"stop"]


def test_the_functions_may_forward_messages_of_http_agents(broker: RunningBroker, space: str) -> None:
    own = f"ts/v1/{space}/arm"
    retained = [f"{own}/conn", *(f"{own}/ur5/{kind}" for kind in ("desc", "desc/twin", "state"))]
    live = [f"{own}/ur5/{kind}" for kind in ("event", "ack", "tele/joints")]
    with broker.client(f"{space}-page", subscribe=(f"{own}/#",)) as page, broker.service() as functions:
        page.subscribe(*retained, *live)
        for topic in (*retained, *live):
            functions.publish_acknowledged(topic, b"now", retain=topic in retained)
        assert [page.receive().topic for _ in (*retained, *live)] == [*retained, *live]
    with broker.client(f"{space}-late", subscribe=(f"{own}/#",)) as late:
        late.subscribe(*retained)
        messages = [late.receive() for _ in retained]
        assert {message.topic: message.retain for message in messages} == dict.fromkeys(retained, True)


def test_the_functions_cannot_publish_setpoints_or_frames(broker: RunningBroker, space: str) -> None:
    own = f"ts/v1/{space}/arm"
    filters = (f"{own}/ur5/ctl/+", f"{own}/ur5/cam/+")
    with listen(broker, space, *filters) as listener:
        for topic in (f"{own}/ur5/ctl/1", f"{own}/ur5/cam/wrist"):
            with broker.service() as functions:
                functions.subscribe(*filters)
                functions.publish(topic, b"x")
                assert listener.received() == []
                assert functions.pending() == []
