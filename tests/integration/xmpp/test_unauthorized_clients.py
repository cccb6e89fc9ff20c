"""Clients without rights, or of another tenant, reach nothing, and no stanza ends the gateway."""

import contextlib
import json
import time
from collections.abc import Iterator
from xml.sax.saxutils import quoteattr

import pytest

from device_agent.protocol import Presence, codec, topics
from device_agent.protocol.xmpp import jids, stanzas
from function_app.services.messaging.xmpp_credentials import AGENT_S
from tests.harness.cloud.cloud import Person
from tests.harness.network.brokers import wait_until
from tests.harness.network.xmpp import DOMAIN, XmppClient, XmppRobot, XmppSite

QUIET_S = 0.3


def password_of(robot: XmppRobot) -> str:
    issued: str = robot.request("POST", "/xmpp/credentials", json={"purpose": "agent"}).json()["password"]
    return issued


@contextlib.contextmanager
def as_agent(site: XmppSite, robot: XmppRobot) -> Iterator[XmppClient]:
    """A client with an agent's password that can send any stanza."""
    with site.client(robot.id, password_of(robot)) as client:
        assert client.opened, client.trouble
        wait_until(lambda: client.is_available(jids.CLOUD), "the gateway")
        yield client


def cloud_jid(client: XmppClient) -> str:
    return next(
        each.get("from", "") for each in reversed(client.presences) if each.get("from", "").startswith("cloud@")
    )


@pytest.fixture
def offline_robot(site: XmppSite, anna: Person) -> Iterator[XmppRobot]:
    """A robot of Anna that is not connected."""
    with site.robot() as robot:
        robot.pair(anna)
        yield robot


class TestLogin:
    def test_a_login_with_a_foreign_password_or_token_is_rejected(
        self, site: XmppSite, anna: Person, offline_robot: XmppRobot
    ) -> None:
        mine = password_of(offline_robot)
        hers = anna.post("/xmpp/credentials", {"purpose": "view"}).json()["password"]
        with site.robot() as other:
            other.pair(site.cloud.sign_in("bert"))
            wrong = [
                (offline_robot.id, "wrong"),
                (offline_robot.id, offline_robot.token()),
                (offline_robot.id, password_of(other)),
                (offline_robot.id, hers),
                (offline_robot.id, mine[:-4] + "AAAA"),
                (other.id, mine),
                (anna.account, mine),
                (anna.account, anna.token),
                (jids.CLOUD, mine),
                (jids.CLOUD, hers),
                ("unknown-user", hers),
            ]
            for user, password in wrong:
                with site.client(user, password) as client:
                    assert not client.opened, (user, password)

    def test_a_password_is_not_valid_for_the_api(self, site: XmppSite, anna: Person, offline_robot: XmppRobot) -> None:
        mine = password_of(offline_robot)
        hers = anna.post("/xmpp/credentials", {"purpose": "view"}).json()["password"]
        for token in (mine, hers):
            headers = {"Authorization": f"Bearer {token}"}
            for method, path in (("GET", "/devices"), ("GET", "/agents/enrollment"), ("POST", "/xmpp/credentials")):
                answer = site.cloud.request(method, f"/api/v1{path}", headers=headers, json={"purpose": "view"})
                assert answer.status_code == 401, path

    def test_a_password_of_an_earlier_pairing_is_refused(self, site: XmppSite, anna: Person) -> None:
        with site.robot() as robot:
            robot.pair(anna)
            before = password_of(robot)
            assert anna.delete(f"/agents/{robot.id}").status_code == 204
            with site.client(robot.id, before) as client:
                assert not client.opened
            robot.pair(site.cloud.sign_in("bert"))
            with site.client(robot.id, before) as client:
                assert not client.opened
            with site.client(robot.id, password_of(robot)) as client:
                assert client.opened

    def test_a_password_expires(self, site: XmppSite, offline_robot: XmppRobot) -> None:
        mine = password_of(offline_robot)
        site.cloud.clock.advance(AGENT_S + 1)
        try:
            with site.client(offline_robot.id, mine) as client:
                assert not client.opened
        finally:
            site.cloud.clock.advance(-AGENT_S - 1)

    def test_a_password_is_invalid_after_signing_out(self, site: XmppSite) -> None:
        carl = site.cloud.sign_in("carl")
        hers = carl.post("/xmpp/credentials", {"purpose": "view"}).json()["password"]
        assert carl.post("/auth/sign-out").status_code == 204
        with site.client(carl.account, hers) as client:
            assert not client.opened

    def test_without_an_xmpp_server_a_request_for_a_password_is_rejected(self, anna: Person, site: XmppSite) -> None:
        access = site.cloud.functions.xmpp_credentials
        domain, access._domain = access._domain, ""
        try:
            answer = anna.post("/xmpp/credentials", {"purpose": "view"})
            assert (answer.status_code, answer.json()["type"]) == (409, "/problems/xmpp-unavailable")
        finally:
            access._domain = domain


class TestTenants:
    def test_clients_can_reach_only_the_cloud(self, site: XmppSite, anna: Person, offline_robot: XmppRobot) -> None:
        bert = site.cloud.sign_in("bert")
        with site.robot() as other, contextlib.ExitStack() as stack:
            other.pair(bert)
            mine = stack.enter_context(as_agent(site, offline_robot))
            hers = stack.enter_context(site.person(anna))
            its = stack.enter_context(as_agent(site, other))
            his = stack.enter_context(site.person(bert))
            users = {mine: offline_robot.id, hers: anna.account, its: other.id, his: bert.account}
            for sender, own in users.items():
                for user in (*users.values(), "cloud" if sender in (hers, his) else "unknown-user"):
                    for to in (f"{user}@{DOMAIN}", f"{user}@{DOMAIN}/test", f"{user}@elsewhere.example"):
                        if own == user and to.endswith((DOMAIN, "/test")):
                            continue
                        sender.send(stanzas.message(to, offline_robot.topic(topics.STATE), b"{}", receipt="1"))
                        sender.send(f"<presence to='{to}' type='subscribe'/>")
                        sender.send(f"<iq to='{to}' type='get' id='2'><ping xmlns='urn:xmpp:ping'/></iq>")
            time.sleep(QUIET_S)
            for client in users:
                assert not [each for each in client.messages if each.get("type") != "error"]
                assert not [each for each in client.presences if each.get("type") == "subscribe"]
            assert not mine.is_available(other.id)
            assert not mine.is_available(bert.account)
            assert mine.is_available(anna.account)
            assert its.is_available(bert.account)

    def test_clients_cannot_change_their_roster(self, site: XmppSite, offline_robot: XmppRobot) -> None:
        with as_agent(site, offline_robot) as client:
            item = "<item jid='zzzzzzzzzz@telescope.localhost' subscription='both'/>"
            client.send(f"<iq type='set' id='3'><query xmlns='jabber:iq:roster'>{item}</query></iq>")
            client.send("<presence to='zzzzzzzzzz@telescope.localhost'/>")
            client.send(stanzas.revoke_user(DOMAIN, offline_robot.id))
            time.sleep(QUIET_S)
            assert not client.ended

    def test_an_agent_publishes_only_its_own_topics(
        self, site: XmppSite, anna: Person, offline_robot: XmppRobot
    ) -> None:
        with site.robot() as other, as_agent(site, offline_robot) as client:
            other.pair(site.cloud.sign_in("bert"))
            other.connect()
            to = cloud_jid(client)
            greeting = codec.encode(Presence(online=True, session=99, at_ms=1))
            client.send(stanzas.message(to, topics.conn(other.space, other.id), greeting, receipt="1"))
            client.send(stanzas.message(to, topics.conn(other.space, offline_robot.id), greeting, receipt="2"))
            client.send(stanzas.message(to, topics.conn(offline_robot.space, offline_robot.id), greeting, receipt="3"))
            wait_until(lambda: any(stanzas.receipt_id(each) == "3" for each in client.messages), "the receipt")
            foreign = other.ack("0" * 31, "done")  # type: ignore[arg-type]
            client.send(stanzas.message(to, other.topic(topics.ACK), codec.encode(foreign), receipt="4"))
            client.send(stanzas.message(to, offline_robot.topic(topics.CMD), b"{}", receipt="5"))
            client.send(stanzas.message(to, offline_robot.topic(topics.STATE, "another"), b"{}", receipt="6"))
            wait_until(lambda: len(refusals(client)) >= 4, "four rejections")
            assert {number for number, _, final in refusals(client) if final} == {"2", "4", "5", "6"}
            assert other.changes == [True]
            assert anna.get(f"/devices/{offline_robot.device}").json()["online"]


def refusals(client: XmppClient) -> list[stanzas.Rejection]:
    return [found for each in client.messages if (found := stanzas.parse_rejection(each)) is not None]


HOSTILE = [
    "<m xmlns='urn:telescope:v1'/>",
    "<m xmlns='urn:telescope:v1' topic='ts/v1/../..'>{}</m>",
    f"<m xmlns='urn:telescope:v1' topic={quoteattr('ts/v1/' + 'a/' * 190)}>{{}}</m>",
    "<m xmlns='urn:telescope:v1' topic='ts/v1/+/+/+/cmd'>{}</m>",
    "<m xmlns='urn:telescope:v1' topic='TOPIC'>" + "[" * 60_000 + "</m>",
    "<m xmlns='urn:telescope:v1' topic='TOPIC'>{&quot;at_ms&quot;: NaN}</m>",
    "<m xmlns='urn:telescope:v1' topic='TOPIC' as='base64'>****</m>",
    "<m xmlns='urn:telescope:v1' topic='TOPIC'>" + "<a>" * 500 + "</a>" * 500 + "</m>",
    "<received xmlns='urn:xmpp:receipts'/>",
    "<body>hello</body>",
    "",
]


def test_no_message_of_an_agent_ends_the_gateway(
    site: XmppSite, offline_robot: XmppRobot, robot: XmppRobot, anna: Person
) -> None:
    with as_agent(site, offline_robot) as client:
        to = cloud_jid(client)
        greeting = codec.encode(Presence(online=True, session=1, at_ms=1))
        client.send(stanzas.message(to, topics.conn(offline_robot.space, offline_robot.id), greeting, receipt="0"))
        for kind in (topics.STATE, topics.ACK, topics.EVENT, topics.DESC, "tele/joints"):
            for number, inside in enumerate(HOSTILE):
                wanted = "" if number % 2 else "<request xmlns='urn:xmpp:receipts'/>"
                body = inside.replace("TOPIC", offline_robot.topic(kind))
                client.send(f"<message to='{to}' id='{kind[:4]}{number}'>{wanted}{body}</message>")
        for deep in (json.dumps({"a": 1}), "nonsense", '{"online": 7}', "[]"):
            client.send(
                stanzas.message(to, topics.conn(offline_robot.space, offline_robot.id), deep.encode(), receipt="9")
            )
        client.send(f"<presence to='{to}' type='unavailable'/><presence to='{to}'><priority>x</priority></presence>")
        client.send(f"<iq to='{to}' type='set' id='8'><query xmlns='jabber:iq:roster'/></iq>")
        wait_until(lambda: len(refusals(client)) >= 10, "refusals")
    assert site.gateways[0].serves(robot.id)
    assert robot.changes == [True]
    assert anna.take_lease(robot.device, wait_ms=10_000).json()["confirmed"]


def test_a_stanza_that_is_too_long_ends_only_the_connection_of_its_sender(
    site: XmppSite, offline_robot: XmppRobot, robot: XmppRobot
) -> None:
    with as_agent(site, offline_robot) as client:
        client.send(f"<message to='{cloud_jid(client)}'><body>{'x' * (2 * stanzas.MAX_STANZA_BYTES)}</body></message>")
        wait_until(lambda: client.ended, "the end of the connection")
    assert robot.changes == [True]
