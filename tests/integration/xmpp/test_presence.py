"""Who is there, and who knows whom."""

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
    """Its socket breaks, as where a machine loses its power."""
    link: Any = robot.link
    inner = link.transport._link
    inner._loop.call_soon_threadsafe(inner.stream._client.transport.abort)


def test_an_agent_that_breaks_off_is_told_to_be_gone_and_comes_back_in_a_new_session(
    site: XmppSite, broker: RunningBroker, anna: Person, robot: XmppRobot
) -> None:
    with site.watcher(broker) as watcher:
        watcher.subscribe(topics.conn(robot.space, robot.id))
        first = codec.decode(watcher.receive().payload, Presence)
        vanish(robot)
        wait_until(lambda: robot.changes == [True, False, True], "the way back")
        wait_until(lambda: online(anna, robot), "online again")
        heard = [codec.decode(watcher.receive().payload, Presence)]
        while not heard[-1].online:
            heard.append(codec.decode(watcher.receive().payload, Presence))
    *gone, back = heard
    assert back.session > first.session
    assert all(presence.session == first.session for presence in gone)


def test_an_old_farewell_that_comes_late_is_contradicted_on_the_broker(
    site: XmppSite, broker: RunningBroker, anna: Person, robot: XmppRobot
) -> None:
    conn = topics.conn(robot.space, robot.id)
    with site.watcher(broker) as other:
        old = Presence(online=False, session=robot.session - 1, at_ms=1)
        other.publish_acknowledged(conn, codec.encode(old), retain=True)

        def kept() -> bool:
            with site.watcher(broker) as late:
                late.subscribe(conn)
                return codec.decode(late.receive().payload, Presence).online

        wait_until(kept, "the newer word to be the one that is kept")
    assert site.speaking[0].serves(robot.id)
    assert online(anna, robot)


def test_a_person_sees_their_agents_and_how_they_are_and_no_others(site: XmppSite, anna: Person) -> None:
    bert = site.cloud.sign_in("bert")
    with site.person(anna) as hers, site.person(bert) as his, site.robot() as robot:
        robot.pair(anna)
        robot.connect()
        wait_until(lambda: hers.there(robot.id), "the agent to be seen")
        robot.publish_state(State(device="arm", at_ms=1, tick_ms=1, mode=Mode.STREAMING, epoch=3))
        wait_until(lambda: hers.messages, "the state")
        told = stanzas.parse(hers.messages[0])
        assert told is not None
        assert codec.decode(told.payload, State).epoch == 3
        assert hers.messages[0].findtext("{jabber:client}body") == "arm: streaming"
        assert robot.link is not None
        robot.link.close()
        wait_until(lambda: not hers.there(robot.id), "the agent to be seen going")
        assert his.messages == []
        assert not any(each.get("from", "").startswith(robot.id) for each in his.presences)


def test_un_pairing_ends_the_connection_and_the_acquaintance(site: XmppSite, anna: Person) -> None:
    with site.person(anna) as hers, site.robot() as robot:
        robot.pair(anna)
        robot.connect()
        wait_until(lambda: hers.there(robot.id), "the agent to be seen")
        began = time.monotonic()
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        wait_until(lambda: robot.changes[-1] is False, "the end of the link")
        assert time.monotonic() - began < 4, "told by the broker, not found at the next look"
        wait_until(lambda: not hers.there(robot.id), "the agent to be gone")
        wait_until(lambda: any("agent-unclaimed" in text for text in robot.refused), "no new password")
        assert robot.changes == [True, False]
        bert = site.cloud.sign_in("bert")
        heard = len(hers.presences)
        with site.person(bert) as his:
            assert robot.link is not None
            robot.link.close()
            robot.pair(bert)
            robot.connect()
            wait_until(lambda: his.there(robot.id), "the agent to be seen by its new owner")
        assert not any(each.get("from", "").startswith(robot.id) for each in hers.presences[heard:])
