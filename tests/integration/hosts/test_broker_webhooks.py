"""Brokers that authorize connections by the functions: Event Grid's webhook and AWS IoT Core's custom authorizer.

Event Grid's namespace is a fake (``tests/fakes/event_grid.py``) with real connections. For IoT Core, only the call that
ends a connection (``DELETE /connections/<client id>``) is fake, because moto does not implement it.
"""

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent.protocol.security import grants, signing
from device_agent.protocol.security.grants import agent_grant
from function_app.adapters.aws.broker_access import IotBrokerAccess
from function_app.adapters.azure import topic_spaces
from function_app.adapters.azure.session_takeover import SessionTakeover
from function_app.adapters.shared.grant_registry import SETTLE_S
from function_app.domain.common.ids import new_id
from function_app.entrypoints.broker_auth.iot_core import authorise
from function_app.ports.broker_access import BrokerAccessError, Credentials
from function_app.ports.tables import StoreError
from function_app.settings import IotBus
from tests.fakes.event_grid import CALLER, event_grid_cloud
from tests.harness.cloud.cloud import Cloud, settings
from tests.harness.network.brokers import HOST
from tests.harness.network.http_server import running
from tests.harness.stores.aws import REGION, use_credentials
from tests.integration.hosts.gates import ARN, Connections, Gate, GridGate, IotGate, access, grant, issue, request_of

_numbers = count()


@pytest.fixture
def account() -> str:
    """An account that no other test uses."""
    return f"a{next(_numbers)}"


class WebhookSuite:
    """``gate`` is the broker under test."""

    def test_other_clients_are_rejected(self, gate: Gate, account: str) -> None:
        own = grant(account)
        right = issue(gate, own)
        forged = grants.issue(own, signing.generate())
        expired = grants.issue(grant(account, lifetime_s=-1), gate.cloud.run(gate.cloud.functions.keys.current()))
        assert gate.admits(right, own.client_id)
        for credentials, client_id in (
            (right, "watch-other"),
            (Credentials("account:b:s2:watch", right.password), own.client_id),
            (Credentials(right.username, forged), own.client_id),
            (Credentials(right.username, expired), own.client_id),
            (Credentials(right.username, ""), own.client_id),
            (Credentials("", "x"), ""),
        ):
            assert not gate.admits(credentials, client_id), (credentials, client_id)

    @pytest.mark.parametrize("named", ["account:{}", "account:{}:s1", "account:{}:s1:watch", "account:{}:+:watch"])
    def test_a_revoked_principal_is_disconnected_and_rejected(self, gate: Gate, account: str, named: str) -> None:
        mine, other = grant(account), grant(f"{account}b")
        old, others = gate.connect(mine), gate.connect(other)
        for _ in range(2):  # a principal that is not connected is no error
            gate.cloud.run(access(gate).revoke(principal=named.format(account)))
            assert gate.ended(mine)
            assert gate.is_connected(other)
        assert not gate.admits(old, mine.client_id)
        assert gate.admits(others, other.client_id)
        assert gate.admits(issue(gate, mine), mine.client_id), "credentials issued afterwards work"

    def test_revoking_a_client_id_affects_no_other_client(self, gate: Gate, account: str) -> None:
        mine, second = grant(account), grant(account, "second")
        old, valid = gate.connect(mine), gate.connect(second)
        gate.cloud.run(access(gate).revoke(client_id=mine.client_id))
        assert gate.ended(mine)
        assert gate.is_connected(second)
        assert (gate.admits(old, mine.client_id), gate.admits(valid, second.client_id)) == (False, True)


# ---------------------------------------------------------------- AWS IoT Core


@pytest.fixture(scope="module")
def iot_gate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[IotGate]:
    connections = Connections()
    with pytest.MonkeyPatch.context() as environment, running(connections):
        use_credentials(environment)
        endpoint = f"http://{HOST}:{connections.server_port}"
        bus = IotBus(region=REGION, endpoint=endpoint, policy="telescope-agents")
        with Cloud(replace(settings(tmp_path_factory.mktemp("iot")), broker="iot", bus=bus)) as cloud:
            yield IotGate(cloud, connections)


class TestIotCore(WebhookSuite):
    @pytest.fixture
    def gate(self, iot_gate: IotGate) -> IotGate:
        return iot_gate

    def test_a_policy_allows_exactly_the_granted_topics(self, gate: IotGate, account: str) -> None:
        own = grant(account)
        username, password = issue(gate, own)
        answer = gate.call_webhook(f"{username}?x-amz-customauthorizer-name=telescope", password, own.client_id)
        assert answer["isAuthenticated"] is True
        assert 890 <= answer["disconnectAfterInSeconds"] <= 900
        text = "".join(answer["policyDocuments"])
        assert f"arn:aws:iot:eu-west-1:123456789012:client/{own.client_id}" in text
        assert f"topicfilter/ts/v1/{account}/*/conn" in text
        assert "ctl" not in text

    def test_expired_grants_are_deleted(self, gate: IotGate, account: str) -> None:
        issue(gate, grant(account))
        access = gate.cloud.functions.access
        assert isinstance(access, IotBrokerAccess)
        gate.cloud.run(access.revoke(client_id="w-gone"))
        gate.cloud.run(access.expire(time.time() + 1000))
        assert gate.cloud.run(access._registry._rows("issued")) == []
        assert gate.cloud.run(access._registry._rows("revoked")) != []
        gate.cloud.run(access.expire(time.time() + 100_000))
        assert gate.cloud.run(access._registry._rows("revoked")) == []

    def test_a_request_without_client_or_with_another_broker_is_rejected(self, gate: IotGate, tmp_path: Path) -> None:
        request: dict[str, Any] = {"protocolData": {}}
        assert gate.cloud.run(authorise(gate.cloud.functions, request, ARN))["isAuthenticated"] is False
        with Cloud(settings(tmp_path)) as cloud, pytest.raises(ValueError, match="requires iot"):
            cloud.run(authorise(cloud.functions, request, ARN))


# ---------------------------------------------------------------- Event Grid


@pytest.fixture(scope="module")
def grid_gate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GridGate]:
    with event_grid_cloud(tmp_path_factory.mktemp("grid")) as parts:
        yield GridGate(*parts)


class TestEventGrid(WebhookSuite):
    @pytest.fixture
    def gate(self, grid_gate: GridGate) -> Iterator[GridGate]:
        yield grid_gate
        for client in grid_gate.clients.values():
            client.close()
        grid_gate.clients.clear()

    def test_a_client_is_admitted_with_exactly_its_topics(self, gate: GridGate, account: str) -> None:
        own = grant(account)
        answer = gate.authorize(issue(gate, own), own.client_id)
        assert (answer["decision"], answer["clientAuthenticationName"]) == ("allow", own.client_id)
        assert answer["expiration"] == own.expires_at
        assert answer["attributes"] == topic_spaces.attributes(own)
        assert set(answer["attributes"].values()) == {"account", account}

    def test_an_invalid_request_is_denied(self, gate: GridGate, account: str) -> None:
        own = grant(account)
        credentials = issue(gate, own)
        valid = request_of(credentials, own.client_id)
        for request in (
            {"clientId": own.client_id},
            valid | {"password": "no base 64"},
            valid | {"password": credentials.password},
            valid | {"userName": 7},
            b"[]",
            b"\xff",
            b"[" * 5_000,
        ):
            status, answer = gate.call_webhook(request)
            assert (status, answer["decision"]) == (200, "deny"), request
        for authorization in ("Bearer other", "", f"Basic {CALLER}"):
            assert gate.call_webhook(valid, authorization=authorization) == (401, {})
        assert gate.call_webhook(b" " * 65_537) == (401, {})

    def test_no_client_is_admitted_if_the_grant_cannot_be_read(
        self, gate: GridGate, account: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        async def fail(*_: Any) -> None:
            raise StoreError("the tables are not available")

        own = grant(account)
        credentials = issue(gate, own)
        monkeypatch.setattr(gate.cloud.functions.tables, "get", fail)
        with pytest.raises(StoreError):
            gate.authorize(credentials, own.client_id)
        assert not gate.broker.accepts(own.client_id, credentials)

    def test_the_client_that_ends_a_connection_has_no_rights(
        self, gate: GridGate, account: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        used: list[Credentials] = []
        access: Any = gate.cloud.functions.access
        take_over = access._take_over

        async def remember(client_id: str, credentials: Credentials) -> None:
            used.append(credentials)
            await take_over(client_id, credentials)

        monkeypatch.setattr(access, "_take_over", remember)
        gate.broker.revoke(client_id=f"w-{account}")
        answer = gate.authorize(used[0], f"w-{account}")
        assert (answer["decision"], answer["attributes"]) == ("allow", {})
        assert answer["expiration"] <= time.time() + 60
        assert gate.authorize(used[0], "w-another")["decision"] == "deny"

    def test_a_connection_ends_with_its_grant(self, gate: GridGate, account: str) -> None:
        expiring, renewed = grant(account), grant(account, "renewed")
        gate.connect(expiring)
        gate.connect(renewed)
        issue(gate, msgspec.structs.replace(renewed, expires_at=renewed.expires_at + 5_000))
        gate.broker.run(gate.broker.access.expire(time.time() + 1_000))
        assert gate.ended(expiring)
        assert gate.is_connected(renewed)

    def test_a_client_that_was_admitted_during_its_revocation_is_disconnected_soon_after(
        self, gate: GridGate, account: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        own, later = grant(account), grant(account, "later")
        credentials = issue(gate, own)
        issue(gate, later)
        allowed = gate.authorize(credentials, own.client_id)
        gate.broker.revoke(principal=f"account:{account}")
        with monkeypatch.context() as patch:
            patch.setattr(gate.grid, "webhook", lambda _: allowed)
            slow = gate.broker.connect(own.client_id, credentials)
        gate.connect(later)
        with slow:
            assert slow.connected.is_set()
            gate.broker.expire()
            assert not slow.disconnected.is_set(), (
                "the client is disconnected by a later check, when no client can still be connecting"
            )
            gate.broker.run(gate.broker.access.expire(time.time() + SETTLE_S + 1))
            assert slow.ended()
        assert gate.is_connected(later), "credentials issued afterwards work"

    def test_an_unreachable_namespace_is_an_error_and_admits_no_client(
        self, gate: GridGate, account: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        own = grant(account)
        credentials = gate.connect(own)
        with monkeypatch.context() as patch:
            patch.setattr(gate.cloud.functions.access, "_take_over", SessionTakeover(host=HOST, port=1, tls=None))
            with pytest.raises(BrokerAccessError, match="cannot be reached"):
                gate.broker.revoke(principal=f"account:{account}")
        assert gate.authorize(credentials, own.client_id)["decision"] == "deny"
        gate.broker.revoke(principal=f"account:{account}")
        assert gate.ended(own)

    def test_topics_that_are_never_granted_are_not_signed(self, gate: GridGate) -> None:
        with pytest.raises(BrokerAccessError, match="topic spaces"):
            gate.broker.issue(grants.gateway_grant(client_id="s", token_id="t", lifetime_s=60))
        with pytest.raises(BrokerAccessError, match="no connection"):
            gate.cloud.functions.access.service_credentials()

    def test_no_client_takes_over_the_session_of_another(self, gate: GridGate, account: str) -> None:
        mine = agent_grant(account, f"agent{account}", token_id=new_id(), lifetime_s=60)
        gate.connect(mine)
        assert not gate.broker.accepts(mine.client_id, issue(gate, grant(account)))
        assert gate.is_connected(mine)

    def test_devices_beyond_the_limit_are_omitted_and_all_named_topics_work(self, gate: GridGate, account: str) -> None:
        anna, bert = gate.cloud.sign_in(f"anna{account}"), gate.cloud.sign_in(f"bert{account}")
        robot = gate.cloud.robot(*(f"arm{number}" for number in range(6)))
        robot.pair(anna)
        for device in robot.devices:
            shared = anna.post(f"/devices/{device}/shares", {"account": bert.name, "role": "operator"})
            assert shared.status_code == 201
        assert anna.post(f"/devices/{robot.device}/stop", {"reason": "smoke"}).status_code < 300
        assert f"ts/v1/{robot.space}/{robot.id}/arm0/stop/{anna.account}" in gate.grid.http_topics
        issued = bert.post("/mqtt/credentials", {"purpose": "view"}).json()
        watched = {topic.split("/")[4] for topic in issued["subscribe"] if topic.endswith("/state")}
        assert len(watched) == topic_spaces.DEVICES
        assert {topic.split("/")[4] for topic in issued["publish"]} == watched
        with gate.broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"])) as client:
            for start in range(0, len(issued["subscribe"]), 8):
                topics = issued["subscribe"][start : start + 8]
                assert client.subscribe(*topics) == [1] * len(topics)
            for topic in issued["publish"]:
                client.publish_acknowledged(topic)
            assert not client.disconnected.is_set()
