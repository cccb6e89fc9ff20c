"""XMPP passwords: purpose, lifetime, contacts, and who is refused (see also tests/integration/xmpp)."""

from collections.abc import Callable
from dataclasses import replace

import httpx
import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.protocol.security import signing
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent
from function_app.domain.identity.accounts import Identity
from function_app.services.identity.authenticator import ACCESS_S, API, SESSION_S
from function_app.services.messaging.xmpp_credentials import AGENT_S, LOGIN_S, Contact, Password, XmppCredentials
from function_app.services.storage import records
from function_app.settings.broker import Xmpp
from tests.fakes.agent import Robot
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API as API_PATH
from tests.harness.cloud.cloud import Cloud, Person, paired, problem

CLOUD_CONTACT = Contact("cloud", "Telescope")


@pytest.fixture
def cloud(open_cloud: OpenCloud) -> Cloud:
    """The functions with an XMPP server."""
    cloud = open_cloud(xmpp=Xmpp(domain="example.org", websocket_url="wss://example.org/xmpp-websocket"))
    cloud.start_ingest()
    return cloud


@pytest.fixture
def credentials(cloud: Cloud) -> XmppCredentials:
    return cloud.functions.xmpp_credentials


def stored(robot: Robot) -> Agent:
    row = robot.cloud.run(robot.cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert row is not None
    return records.read(row, Agent)


def store(cloud: Cloud, agent: Agent) -> None:
    row = cloud.run(cloud.functions.tables.get(records.AGENTS, agent.id, "agent"))
    assert row is not None
    cloud.run(cloud.functions.tables.replace(records.AGENTS, row.changed(records.to_data(agent))))


def identity(person: Person) -> Identity:
    return Identity(person.account, person.name, person.session)


def signed_in_page(cloud: Cloud, account: str) -> Callable[[str, object], httpx.Response]:
    """Sends changing requests of a page with the cookie of its session."""
    client = cloud.client()
    answer = cloud.run(client.post(f"{API_PATH}/auth/sign-in", json={"link": cloud.link(account)}))
    headers = {"X-CSRF-Token": answer.json()["csrf_token"]}
    return lambda path, body: cloud.run(client.post(API_PATH + path, json=body, headers=headers))


def passwords(cloud: Cloud, anna: Person, robot: Robot) -> dict[str, Password]:
    credentials = cloud.functions.xmpp_credentials
    return {
        "agent": cloud.run(credentials.agent(stored(robot))),
        "account": cloud.run(credentials.account(identity(anna))),
        "cloud": cloud.run(credentials.cloud()),
    }


def test_an_agent_is_admitted_with_the_cloud_and_its_owner(
    cloud: Cloud, credentials: XmppCredentials, anna: Person, robot: Robot
) -> None:
    issued = passwords(cloud, anna, robot)["agent"]
    now_s = cloud.clock.now_ms() // 1000
    assert (issued.user, issued.lifetime_s) == (robot.id, AGENT_S)
    assert issued.expires_ms in {(now_s + AGENT_S) * 1000, (now_s - 1 + AGENT_S) * 1000}
    cloud.clock.advance(600)
    admitted = cloud.run(credentials.verify(robot.id, issued.password))
    assert (admitted.user, admitted.name, admitted.kind) == (robot.id, stored(robot).name, "agent")
    assert admitted.contacts == (CLOUD_CONTACT, Contact(anna.account, "anna"))
    assert AGENT_S - 602 <= admitted.lifetime_s <= AGENT_S - 600


def test_an_account_is_admitted_with_its_xmpp_agents(
    cloud: Cloud, credentials: XmppCredentials, anna: Person, robot: Robot
) -> None:
    with paired(cloud, "anna"), paired(cloud, "bert") as (_, foreign):
        for each in (robot, foreign):
            store(cloud, replace(stored(each), transport="xmpp"))
        issued = passwords(cloud, anna, robot)["account"]
        assert (issued.user, issued.lifetime_s) == (anna.account, SESSION_S)
        assert issued.expires_ms - cloud.clock.now_ms() == pytest.approx(SESSION_S * 1000, abs=1000)
        admitted = cloud.run(credentials.verify(anna.account, issued.password))
        assert (admitted.user, admitted.name, admitted.kind) == (anna.account, "anna", "account")
        assert admitted.contacts == (CLOUD_CONTACT, Contact(robot.id, stored(robot).name))
        assert admitted.lifetime_s == LOGIN_S


def test_a_browser_gets_a_password_and_an_access_token_that_both_expire_soon(
    cloud: Cloud, credentials: XmppCredentials, anna: Person
) -> None:
    issued, token = cloud.run(credentials.browser(identity(anna)))
    assert (issued.user, issued.lifetime_s) == (anna.account, ACCESS_S)
    assert issued.expires_ms - cloud.clock.now_ms() == pytest.approx(ACCESS_S * 1000, abs=100)
    assert cloud.run(credentials.verify(anna.account, issued.password)).user == anna.account
    caller = cloud.run(cloud.functions.authenticator.person(token, API))
    assert (caller.account, caller.session) == (anna.account, anna.session)
    cloud.clock.advance(ACCESS_S + 1)
    with pytest.raises(Problem, match="expired"):
        cloud.run(cloud.functions.authenticator.person(token, API))
    with pytest.raises(Problem, match="expired"):
        cloud.run(credentials.verify(anna.account, issued.password))


def test_a_server_without_browsers_issues_no_token(open_cloud: OpenCloud) -> None:
    cloud = open_cloud(xmpp=Xmpp(domain="example.org"))
    anna = cloud.sign_in("anna")
    with pytest.raises(Problem, match="TELESCOPE_XMPP_WEBSOCKET_URL") as problem:
        cloud.run(cloud.functions.xmpp_credentials.browser(identity(anna)))
    assert (problem.value.code, problem.value.status) == ("xmpp-unavailable", 409)
    assert problem.value.title == "No XMPP server for browsers"


def test_without_an_xmpp_server_the_setting_of_its_domain_is_named(open_cloud: OpenCloud) -> None:
    cloud = open_cloud()
    anna = cloud.sign_in("anna")
    with pytest.raises(Problem, match="TELESCOPE_XMPP_DOMAIN"):
        cloud.run(cloud.functions.xmpp_credentials.browser(identity(anna)))


def test_a_page_gets_a_token_only_with_its_lease(cloud: Cloud, anna: Person, robot: Robot) -> None:
    control = {"purpose": "control", "device": robot.device, "epoch": 1}
    post = signed_in_page(cloud, "anna")
    refused = post("/xmpp/credentials", control)
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/lease-lost")
    assert signed_in_page(cloud, "bert")("/xmpp/credentials", control).status_code == 404
    lease = post(f"/devices/{robot.device}/lease", {}).json()
    issued = post("/xmpp/credentials", {**control, "epoch": lease["epoch"]})
    assert issued.status_code == 200, issued.text
    assert issued.headers["cache-control"] == "no-store"
    body = issued.json()
    assert body["websocket_url"] == "wss://example.org/xmpp-websocket"
    assert (body["jid"], body["cloud"]) == (f"{anna.account}@example.org", "cloud@example.org")
    assert body["token"]
    assert anna.get(f"/devices/{robot.device}").json()["setpoints_over"] == ["mqtt", "xmpp"]
    view = anna.post("/xmpp/credentials", {"purpose": "view"}).json()
    assert (view["token"], view["websocket_url"]) == ("", "")


def test_an_access_token_does_not_renew_itself(anna: Person, robot: Robot) -> None:
    lease = anna.take_lease(robot.device).json()
    request = {"purpose": "control", "device": robot.device, "epoch": lease["epoch"]}
    assert "cannot renew itself" in problem(anna.post("/xmpp/credentials", request), 403, "forbidden")["detail"]


def test_an_account_with_many_agents_gets_all_as_contacts(
    cloud: Cloud, credentials: XmppCredentials, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = replace(stored(robot), transport="xmpp")
    pages = {None: ([first], "1"), "1": ([replace(first, id="second")], None)}

    async def agents(_: Identity, *, cursor: str | None, limit: int) -> tuple[list[Agent], str | None]:
        assert limit > 0
        return pages.pop(cursor)

    monkeypatch.setattr(cloud.functions.devices, "agents", agents)
    admitted = cloud.run(credentials.verify(anna.account, passwords(cloud, anna, robot)["account"].password))
    assert [contact.user for contact in admitted.contacts] == ["cloud", robot.id, "second"]


def test_the_gateway_is_admitted_without_contacts(
    cloud: Cloud, credentials: XmppCredentials, anna: Person, robot: Robot
) -> None:
    issued = passwords(cloud, anna, robot)["cloud"]
    assert (issued.user, issued.lifetime_s) == ("cloud", AGENT_S)
    admitted = cloud.run(credentials.verify("cloud", issued.password))
    assert (admitted.user, admitted.name, admitted.kind, admitted.contacts) == ("cloud", "Telescope", "cloud", ())
    assert AGENT_S - 2 <= admitted.lifetime_s <= AGENT_S


@pytest.mark.parametrize(
    ("user", "kind"),
    [
        (user, kind)
        for user in ("agent", "account", "cloud")
        for kind in ("agent", "account", "cloud", "access token", "no token")
        if user != kind
    ],
)
def test_a_password_admits_only_its_user(cloud: Cloud, anna: Person, robot: Robot, user: str, kind: str) -> None:
    issued = passwords(cloud, anna, robot)
    texts = {name: each.password for name, each in issued.items()} | {"access token": anna.token, "no token": "x"}
    with pytest.raises(Problem) as problem:
        cloud.run(cloud.functions.xmpp_credentials.verify(issued[user].user, texts[kind]))
    assert (problem.value.code, problem.value.status) == ("unauthorized", 401)


def test_a_password_admits_no_other_account(
    cloud: Cloud, credentials: XmppCredentials, anna: Person, robot: Robot
) -> None:
    bert = cloud.sign_in("bert")
    with pytest.raises(Problem, match="wrong"):
        cloud.run(credentials.verify(bert.account, passwords(cloud, anna, robot)["account"].password))


@pytest.mark.parametrize(
    "change",
    [lambda agent: replace(agent, account=None), lambda agent: replace(agent, pairing="another")],
    ids=["released", "paired again"],
)
def test_a_password_ends_with_the_pairing(
    cloud: Cloud, credentials: XmppCredentials, anna: Person, robot: Robot, change: Callable[[Agent], Agent]
) -> None:
    issued = passwords(cloud, anna, robot)["agent"]
    store(cloud, change(stored(robot)))
    with pytest.raises(Problem, match="wrong"):
        cloud.run(credentials.verify(robot.id, issued.password))


def test_passwords_expire(cloud: Cloud, credentials: XmppCredentials, anna: Person, robot: Robot) -> None:
    issued = passwords(cloud, anna, robot)
    cloud.clock.advance(AGENT_S + 1)
    for user in ("agent", "cloud"):
        with pytest.raises(Problem, match="wrong"):
            cloud.run(credentials.verify(issued[user].user, issued[user].password))


def test_a_password_is_valid_until_its_last_second(cloud: Cloud, credentials: XmppCredentials) -> None:
    issued = cloud.run(credentials.cloud())
    left_ms = issued.expires_ms - cloud.clock.now_ms()
    cloud.clock.advance((left_ms - 2) / 1000)  # each call takes one millisecond
    assert cloud.run(credentials.verify("cloud", issued.password)).lifetime_s == 1
    with pytest.raises(Problem, match="wrong"):
        cloud.run(credentials.verify("cloud", issued.password))


def test_a_password_names_its_issuer_and_key(
    cloud: Cloud, credentials: XmppCredentials, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the key that it names is read, because the key may be new."""
    password = cloud.run(credentials.cloud()).password
    assert jwt.decode(password, options={"verify_signature": False})["iss"] == "telescope"
    key = cloud.run(cloud.functions.keys.current()).public_key()

    async def public(wanted: str = "") -> dict[str, Ed25519PublicKey]:
        return {wanted: key} if wanted == signing.key_id(key) else {}

    monkeypatch.setattr(cloud.functions.keys, "public", public)
    assert cloud.run(credentials.verify("cloud", password)).kind == "cloud"


@pytest.mark.parametrize("headers", [{}, {"kid": "unknown"}])
def test_a_password_of_an_unknown_key_is_refused(
    cloud: Cloud, credentials: XmppCredentials, headers: dict[str, str]
) -> None:
    claims = jwt.decode(cloud.run(credentials.cloud()).password, options={"verify_signature": False})
    forged = jwt.encode(claims, signing.generate(), "EdDSA", headers=headers)
    with pytest.raises(Problem, match="wrong"):
        cloud.run(credentials.verify("cloud", forged))


def test_without_a_server_nothing_is_issued_or_verified(open_cloud: OpenCloud) -> None:
    cloud = open_cloud()
    credentials = cloud.functions.xmpp_credentials
    anna = cloud.sign_in("anna")
    agent = Agent(id="a", name="lab", public_key="", software="", devices=(), created_ms=0)
    for call in (
        credentials.agent(agent),
        credentials.cloud(),
        credentials.account(identity(anna)),
        credentials.verify("cloud", "x"),
    ):
        with pytest.raises(Problem) as problem:
            cloud.run(call)
        assert (problem.value.code, problem.value.status) == ("xmpp-unavailable", 409)


def test_an_unclaimed_agent_gets_no_password(cloud: Cloud, credentials: XmppCredentials, robot: Robot) -> None:
    with pytest.raises(Problem) as problem:
        cloud.run(credentials.agent(replace(stored(robot), space=None)))
    assert problem.value.code == "agent-unclaimed"
