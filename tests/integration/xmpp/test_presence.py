"""Presence of agents for people and at the broker."""

import time
from typing import Any

from device_agent.protocol import Mode, Presence, State, codec, topics
from device_agent.protocol.xmpp import stanzas
from tests.harness.cloud.cloud import Person
from tests.harness.network.brokers import RunningBroker, wait_until
from tests.harness.network.xmpp import XmppRobot, XmppSite


def online(anna: Person, robot: XmppRobot) -> bool:
    return bool(anna.get(f"/devices/{robot.device}").json()["online"])


def vanish(robot: XmppRobot) -> None:
    """Abort the robot's connection without a closing stanza."""
    link: Any = robot.link
    inner = link.transport._link
    inner._loop.call_soon_threadsafe(inner.stream._client.transport.abort)


def test_a_disconnected_agent_is_offline_and_reconnects_in_a_new_session(
    site: XmppSite, broker: RunningBroker, anna: Person, robot: XmppRobot
) -> None:
    with site.watcher(broker) as watcher:
        watcher.subscribe(topics.conn(robot.space, robot.id))
        first = codec.decode(watcher.receive().payload, Presence)
        vanish(robot)
        wait_until(lambda: robot.changes == [True, False, True], "the new link")
        wait_until(lambda: online(anna, robot), "online again")
        presences = [codec.decode(watcher.receive().payload, Presence)]
        while not presences[-1].online:
            presences.append(codec.decode(watcher.receive().payload, Presence))
    *offline, back = presences
    assert back.session > first.session
    assert all(presence.session == first.session for presence in offline)


def test_a_late_offline_presence_of_an_earlier_session_is_replaced_on_the_broker(
    site: XmppSite, broker: RunningBroker, anna: Person, robot: XmppRobot
) -> None:
    conn = topics.conn(robot.space, robot.id)
    with site.watcher(broker) as other:
        old = Presence(online=False, session=robot.session - 1, at_ms=1)
        other.publish_acknowledged(conn, codec.encode(old), retain=True)

        def replaced() -> bool:
            with site.watcher(broker) as late:
                late.subscribe(conn)
                return codec.decode(late.receive().payload, Presence).online

        wait_until(replaced, "the newer presence to be retained")
    assert site.gateways[0].serves(robot.id)
    assert online(anna, robot)


def test_a_person_receives_presence_and_state_of_their_own_agents_only(site: XmppSite, anna: Person) -> None:
    bert = site.cloud.sign_in("bert")
    with site.person(anna) as hers, site.person(bert) as his, site.robot() as robot:
        robot.pair(anna)
        robot.connect()
        wait_until(lambda: hers.is_available(robot.id), "the agent to be available")
        robot.publish_state(State(device="arm", at_ms=1, tick_ms=1, mode=Mode.STREAMING, epoch=3))
        wait_until(lambda: hers.messages, "the state")
        delivery = stanzas.parse(hers.messages[0])
        assert delivery is not None
        assert codec.decode(delivery.payload, State).epoch == 3
        assert hers.messages[0].findtext("{jabber:client}body") == "arm: streaming"
        assert robot.link is not None
        robot.link.close()
        wait_until(lambda: not hers.is_available(robot.id), "the agent to be unavailable")
        assert his.messages == []
        assert not any(each.get("from", "").startswith(robot.id) for each in his.presences)


def test_unpairing_ends_the_connection_and_the_presence_subscription(site: XmppSite, anna: Person) -> None:
    with site.person(anna) as hers, site.robot() as robot:
        robot.pair(anna)
        robot.connect()
        wait_until(lambda: hers.is_available(robot.id), "the agent to be available")
        began = time.monotonic()
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        wait_until(lambda: robot.changes[-1] is False, "the end of the link")
        assert time.monotonic() - began < 4, (
            "the agent must be disconnected by an event, not by the next periodic check"
        )
        wait_until(lambda: not hers.is_available(robot.id), "the agent to be unavailable")
        wait_until(lambda: any("agent-unclaimed" in text for text in robot.login_errors), "no new password")
        assert robot.changes == [True, False]
        bert = site.cloud.sign_in("bert")
        count = len(hers.presences)
        with site.person(bert) as his:
            assert robot.link is not None
            robot.link.close()
            robot.pair(bert)
            robot.connect()
            wait_until(lambda: his.is_available(robot.id), "the agent to be available for its new owner")
        assert not any(each.get("from", "").startswith(robot.id) for each in hers.presences[count:])
