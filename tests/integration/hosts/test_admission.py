"""Event Grid as the broker: its webhook as it is asked, and what taking rights back does to connections.

The namespace is a fake (``tests/fakes/event_grid.py``); connections to it, and the functions' own, are real.
"""

import base64
import json
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from device_agent.protocol.security import grants, signing
from device_agent.protocol.security.grants import Grant, agent_grant
from function_app.adapters.azure import topic_spaces
from function_app.adapters.azure.session_takeover import SessionTakeover
from function_app.adapters.shared.grant_registry import SETTLE_S
from function_app.domain.common.ids import new_id
from function_app.entrypoints.broker_auth.event_grid import admit
from function_app.ports.broker_access import BrokerAccessError, Credentials
from function_app.ports.tables import StoreError
from tests.fakes.event_grid import CALLER, EventGrid, event_grid_cloud
from tests.harness.cloud.cloud import Cloud
from tests.harness.network.brokers import HOST, PATIENCE_S, Client, RunningBroker

_numbers = iter(range(1_000))


class There(NamedTuple):
    cloud: Cloud
    broker: RunningBroker
    grid: EventGrid


@pytest.fixture(scope="module")
def there(tmp_path_factory: pytest.TempPathFactory) -> Iterator[There]:
    with event_grid_cloud(tmp_path_factory.mktemp("grid")) as found:
        yield There(*found)


@pytest.fixture
def account() -> str:
    """One that no other test uses."""
    return f"a{next(_numbers)}"


def grant(account: str, client: str = "w", *, session: str = "s1", lifetime_s: float = 900) -> Grant:
    return Grant(
        principal=f"account:{account}:{session}:watch",
        client_id=f"{client}-{account}",
        publish=(f"ts/v1/{account}/+/+/stop",),
        subscribe=grants.device_subscriptions(account, "+", "+"),
        token_id=new_id(),
        expires_at=int(time.time() + lifetime_s),
    )


def ask(there: There, wanted: Any, *, caller: str = CALLER) -> tuple[int, dict[str, Any]]:
    body = wanted if isinstance(wanted, bytes) else json.dumps(wanted).encode()
    return there.cloud.run(admit(there.cloud.functions, f"Bearer {caller}", body))


def connect_of(credentials: Credentials, client_id: str) -> dict[str, str]:
    password = base64.b64encode(credentials.password.encode()).decode()
    return {"clientId": client_id, "userName": credentials.username, "password": password}


def enter(there: There, wanted: Grant) -> tuple[Client, Credentials]:
    credentials = there.broker.issue(wanted)
    client = there.broker.connect(wanted.client_id, credentials)
    assert client.connected.is_set(), client.answer
    return client, credentials


def test_who_has_credentials_is_let_in_with_exactly_its_topics(there: There, account: str) -> None:
    wanted = grant(account)
    status, answer = ask(there, connect_of(there.broker.issue(wanted), wanted.client_id))
    assert (status, answer["decision"]) == (200, "allow")
    assert answer["clientAuthenticationName"] == wanted.client_id
    assert answer["expiration"] == wanted.expires_at
    assert answer["attributes"] == topic_spaces.attributes(wanted)
    assert set(answer["attributes"].values()) == {"account", account}


def test_other_clients_are_rejected(there: There, account: str) -> None:
    wanted = grant(account)
    good = there.broker.issue(wanted)
    forged = grants.issue(wanted, signing.generate())
    over = grants.issue(grant(account, lifetime_s=-1), there.cloud.run(there.cloud.functions.keys.current()))
    for tried in (
        connect_of(good, "w-other"),
        connect_of(Credentials("account:b:s:watch", good.password), wanted.client_id),
        connect_of(Credentials(good.username, forged), wanted.client_id),
        connect_of(Credentials(good.username, over), wanted.client_id),
        connect_of(Credentials("", ""), ""),
        {"clientId": wanted.client_id},
        {**connect_of(good, wanted.client_id), "password": "no base 64"},
        {**connect_of(good, wanted.client_id), "password": good.password},
        {**connect_of(good, wanted.client_id), "userName": 7},
        b"[]",
        b"\xff",
        b"[" * 5_000,
    ):
        status, answer = ask(there, tried)
        assert (status, answer["decision"]) == (200, "deny"), tried
        assert set(answer) == {"decision", "errorReason"}


def test_only_the_namespace_is_answered(there: There, account: str) -> None:
    wanted = grant(account)
    good = connect_of(there.broker.issue(wanted), wanted.client_id)
    assert ask(there, good, caller="other") == (401, {})
    assert there.cloud.run(admit(there.cloud.functions, "", json.dumps(good).encode())) == (401, {})
    assert there.cloud.run(admit(there.cloud.functions, f"Basic {CALLER}", json.dumps(good).encode())) == (401, {})
    assert ask(there, b" " * 65_537) == (401, {})


def test_no_client_is_admitted_if_the_grant_cannot_be_read(
    there: There, account: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def away(*_: Any) -> None:
        raise StoreError("the tables are away")

    wanted = grant(account)
    credentials = there.broker.issue(wanted)
    monkeypatch.setattr(there.cloud.functions.tables, "get", away)
    with pytest.raises(StoreError):
        ask(there, connect_of(credentials, wanted.client_id))
    with there.broker.connect(wanted.client_id, credentials) as client:
        assert not client.connected.is_set()


@pytest.mark.parametrize("named", ["account:{}", "account:{}:s1", "account:{}:s1:watch", "account:{}:+:watch"])
def test_what_is_taken_back_is_cut_and_not_let_in_again(there: There, account: str, named: str) -> None:
    (mine, old), (other, _) = enter(there, grant(account)), enter(there, grant(f"{account}b"))
    with mine, other:
        begun_s = time.monotonic()
        there.broker.revoke(principal=named.format(account))
        assert mine.disconnected.wait(PATIENCE_S)
        print(f"cut after {1000 * (time.monotonic() - begun_s):.0f} ms")  # noqa: T201
        assert not other.disconnected.is_set()
        with there.broker.connect(mine.client_id, old) as again:
            assert not again.connected.is_set()
        new, _ = enter(there, grant(account))
        new.close()
        there.broker.revoke(principal=named.format(account))  # who is not connected is no error


def test_a_client_id_is_taken_back_alone(there: There, account: str) -> None:
    (mine, _), (second, _) = enter(there, grant(account)), enter(there, grant(account, "x"))
    with mine, second:
        there.broker.revoke(client_id=mine.client_id)
        assert mine.disconnected.wait(PATIENCE_S)
        assert not second.disconnected.is_set()


def test_who_comes_to_cut_may_say_and_hear_nothing(there: There, account: str) -> None:
    taken: list[Credentials] = []
    access: Any = there.cloud.functions.access
    take = access._take

    async def remember(client_id: str, credentials: Credentials) -> None:
        taken.append(credentials)
        await take(client_id, credentials)

    access._take = remember
    try:
        there.broker.revoke(client_id=f"w-{account}")
    finally:
        access._take = take
    _, answer = ask(there, connect_of(taken[0], f"w-{account}"))
    assert (answer["decision"], answer["attributes"]) == ("allow", {})
    assert answer["expiration"] <= time.time() + 60
    _, answer = ask(there, connect_of(taken[0], "w-another"))
    assert answer["decision"] == "deny"


def test_a_connection_ends_with_its_grant(there: There, account: str) -> None:
    (mine, _), (renewed, _) = enter(there, grant(account)), enter(there, grant(account, "x"))
    there.broker.issue(replace_end(grant(account, "x"), 5_000))
    with mine, renewed:
        there.broker.run(there.broker.access.expire(time.time() + 1_000))
        assert mine.disconnected.wait(PATIENCE_S)
        assert not renewed.disconnected.is_set()


def replace_end(wanted: Grant, lifetime_s: float) -> Grant:
    values = {name: getattr(wanted, name) for name in wanted.__struct_fields__}
    return Grant(**{**values, "expires_at": int(time.time() + lifetime_s)})


def test_who_was_being_let_in_at_the_moment_of_a_revocation_is_cut_soon_after(there: There, account: str) -> None:
    wanted, later = grant(account), grant(account, "x")
    credentials, _ = there.broker.issue(wanted), there.broker.issue(later)
    _, allowed = ask(there, connect_of(credentials, wanted.client_id))
    there.broker.revoke(principal=f"account:{account}")
    webhook, there.grid.webhook = there.grid.webhook, lambda _: allowed
    slow = there.broker.connect(wanted.client_id, credentials)
    there.grid.webhook = webhook
    new, _ = enter(there, later)
    with slow, new:
        assert slow.connected.is_set()
        there.broker.expire()
        assert not slow.disconnected.is_set(), "it is found later, when no client can still be connecting"
        there.broker.run(there.broker.access.expire(time.time() + SETTLE_S + 1))
        assert slow.disconnected.wait(PATIENCE_S)
        assert not new.disconnected.is_set(), "credentials issued afterwards work"


def test_an_unreachable_namespace_is_one_clear_error_and_admits_no_client(there: There, account: str) -> None:
    access: Any = there.cloud.functions.access
    take, access._take = access._take, SessionTakeover(host=HOST, port=1, tls=None)
    client, credentials = enter(there, grant(account))
    try:
        with pytest.raises(BrokerAccessError, match="cannot be reached"):
            there.broker.revoke(principal=f"account:{account}")
    finally:
        access._take = take
    with client:
        _, answer = ask(there, connect_of(credentials, client.client_id))
        assert answer["decision"] == "deny"
        there.broker.revoke(principal=f"account:{account}")
        assert client.disconnected.wait(PATIENCE_S)


def test_topics_that_are_never_granted_are_not_signed(there: There) -> None:
    with pytest.raises(BrokerAccessError, match="topic spaces"):
        there.broker.issue(grants.gateway_grant(client_id="s", token_id="t", lifetime_s=60))
    with pytest.raises(BrokerAccessError, match="no connection"):
        there.cloud.functions.access.service_credentials()


def test_no_client_takes_over_the_session_of_another(there: There, account: str) -> None:
    mine, _ = enter(there, agent_grant(account, f"agent{account}", token_id=new_id(), lifetime_s=60))
    thief = there.broker.issue(grant(account))
    with mine, there.broker.connect(mine.client_id, thief) as other:
        assert not other.connected.is_set()
        assert not mine.disconnected.is_set()


def test_what_does_not_fit_is_left_out_and_all_that_is_named_is_there(there: There, account: str) -> None:
    anna, bert = there.cloud.sign_in(f"anna{account}"), there.cloud.sign_in(f"bert{account}")
    robot = there.cloud.robot(*(f"arm{number}" for number in range(6)))
    robot.pair(anna)
    for device in robot.devices:
        shared = anna.post(f"/devices/{device}/shares", {"account": bert.name, "role": "operator"})
        assert shared.status_code == 201
    issued = bert.post("/mqtt/credentials", {"purpose": "view"}).json()
    heard = {topic.split("/")[4] for topic in issued["subscribe"] if topic.endswith("/state")}
    assert len(heard) == topic_spaces.DEVICES
    assert {topic.split("/")[4] for topic in issued["publish"]} == heard
    credentials = Credentials(issued["username"], issued["password"])
    with there.broker.connect(issued["client_id"], credentials) as client:
        topics = issued["subscribe"]
        for start in range(0, len(topics), 8):
            some = topics[start : start + 8]
            assert client.subscribe(*some) == [1] * len(some)
        for topic in issued["publish"]:
            client.publish_acknowledged(topic)
        assert not client.disconnected.is_set()


def test_a_command_goes_where_the_functions_may_publish(there: There, account: str) -> None:
    anna = there.cloud.sign_in(f"anna{account}")
    robot = there.cloud.robot()
    robot.pair(anna)
    assert anna.post(f"/devices/{robot.device}/stop", {"reason": "smoke"}).status_code < 300
    assert f"ts/v1/{robot.space}/{robot.id}/arm/stop" in there.grid.said
