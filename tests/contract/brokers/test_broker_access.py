"""``BrokerAccess`` of each broker."""

import asyncio
import math
import time
from pathlib import Path

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import signing
from function_app.adapters.local.broker_access import MosquittoBrokerAccess, TokenBrokerAccess
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError, Credentials
from tests.contract.conftest import Brokers
from tests.harness.network.brokers import HOST, BrokerKind, RunningBroker, start_broker


def another_instance(broker: RunningBroker) -> BrokerAccess:
    """The access of a second function instance."""
    if broker.kind == "mosquitto":
        return MosquittoBrokerAccess(
            host=HOST, port=broker.tcp_port, username="service", password_file=broker.home / "service.password"
        )

    async def publish(topic: str, payload: bytes) -> None:
        def send() -> None:
            with broker.service() as client:
                client.publish_acknowledged(topic, payload)

        await asyncio.to_thread(send)

    return TokenBrokerAccess(signer=lambda: broker.key, publish=publish)


def test_invalid_client_ids_and_filters_are_rejected(broker: RunningBroker, space: str) -> None:
    for client_id in ("", "with space", "a/b", "a+", "x" * 65, "ü"):
        with pytest.raises(ProtocolError, match="client id"):
            broker.issue(broker.grant(client_id))
    for pattern in ("a/#/b", "a#"):
        for grant in (broker.grant(space, publish=(pattern,)), broker.grant(space, subscribe=(pattern,))):
            with pytest.raises(ProtocolError, match="filter"):
                broker.issue(grant)


def test_revoke_requires_exactly_one_name_which_may_be_unknown(broker: RunningBroker, space: str) -> None:
    for names in ({}, {"client_id": "a", "principal": "b"}):
        with pytest.raises(ValueError, match="exactly one"):
            broker.revoke(**names)
    for _ in range(2):
        broker.revoke(client_id=space)
        broker.revoke(principal=f"account:{space}")


def test_concurrent_calls_all_succeed(broker: RunningBroker, space: str) -> None:
    async def issue_many() -> list[Credentials]:
        wanted = (broker.grant(f"{space}-{number}", subscribe=(f"ts/v1/{space}/+/conn",)) for number in range(30))
        return list(await asyncio.gather(*(broker.access.issue(grant) for grant in wanted)))

    credentials = broker.run(issue_many())
    for number in (0, 15, 29):
        assert broker.accepts(f"{space}-{number}", credentials[number])


def test_any_instance_revokes_credentials_of_another(broker: RunningBroker, space: str) -> None:
    other = another_instance(broker)
    with broker.client(space) as client:
        broker.run(other.revoke(client_id=space))
        assert client.ended()
    for _ in range(2):
        broker.run(other.close())


def test_service_connections_have_distinct_client_ids(broker: RunningBroker) -> None:
    first, second = broker.access.service_credentials(), broker.access.service_credentials()
    assert first.client_id != second.client_id
    assert first.expires_at > time.time() + 3_600
    assert (first.expires_at == math.inf) == (broker.kind == "mosquitto")
    with broker.service() as one, broker.service() as another:
        assert one.connected.is_set()
        assert another.connected.is_set()
        assert not one.disconnected.is_set()


def test_an_unavailable_broker_is_an_error_until_it_returns(kind: BrokerKind, tmp_path: Path) -> None:
    with start_broker(kind, tmp_path) as broker:
        access = another_instance(broker)
        broker.run(access.revoke(client_id="unknown"))
        broker.kill()
        with pytest.raises(BrokerAccessError):
            broker.run(access.revoke(client_id="unknown"))
        with start_broker(kind, tmp_path, tcp_port=broker.tcp_port, websocket_port=broker.websocket_port) as again:
            again.run(access.revoke(client_id="unknown"))
            broker.run(access.close()) if kind == "amqtt" else again.run(access.close())


def test_a_missing_password_file_is_an_error(tmp_path: Path) -> None:
    access = MosquittoBrokerAccess(host=HOST, port=1, username="service", password_file=tmp_path / "none")
    with pytest.raises(BrokerAccessError, match="start the broker"):
        access.service_credentials()


def test_a_token_of_another_key_is_rejected(brokers: Brokers, space: str) -> None:
    async def unexpected(_: str, __: bytes) -> None:
        raise AssertionError("unexpected publish")

    broker = brokers("amqtt")
    forger = TokenBrokerAccess(signer=signing.generate, publish=unexpected)
    assert not broker.accepts(space, broker.run(forger.issue(broker.grant(space, publish=("#",)))))
