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
from tests.harness.network.brokers import HOST, PATIENCE_S, BrokerKind, RunningBroker, start_broker


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


@pytest.mark.parametrize("client_id", ["", "with space", "a/b", "a+", "x" * 65, "ü"])
def test_an_invalid_client_id_is_rejected(broker: RunningBroker, client_id: str) -> None:
    with pytest.raises(ProtocolError, match="client id"):
        broker.issue(broker.grant(client_id))


@pytest.mark.parametrize("pattern", ["a/#/b", "a#"])
def test_an_invalid_filter_is_rejected(broker: RunningBroker, space: str, pattern: str) -> None:
    for grant in (broker.grant(space, publish=(pattern,)), broker.grant(space, subscribe=(pattern,))):
        with pytest.raises(ProtocolError, match="filter"):
            broker.issue(grant)


def test_revoke_requires_exactly_one_name(broker: RunningBroker) -> None:
    with pytest.raises(ValueError, match="exactly one"):
        broker.revoke()
    with pytest.raises(ValueError, match="exactly one"):
        broker.revoke(client_id="a", principal="b")


def test_revoking_an_unknown_name_succeeds(broker: RunningBroker, space: str) -> None:
    for _ in range(2):
        broker.revoke(client_id=space)
        broker.revoke(principal=f"account:{space}")


def test_many_calls_at_once_all_succeed(broker: RunningBroker, space: str) -> None:
    async def many() -> list[Credentials]:
        wanted = (broker.grant(f"{space}-{number}", subscribe=(f"ts/v1/{space}/+/conn",)) for number in range(30))
        return list(await asyncio.gather(*(broker.access.issue(grant) for grant in wanted)))

    credentials = broker.run(many())
    for number in (0, 15, 29):
        with broker.connect(f"{space}-{number}", credentials[number]) as client:
            assert client.connected.is_set()


def test_any_instance_revokes_what_another_has_issued(broker: RunningBroker, space: str) -> None:
    other = another_instance(broker)
    with broker.client(space) as client:
        broker.run(other.revoke(client_id=space))
        assert client.disconnected.wait(PATIENCE_S)
    broker.run(other.close())
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


def test_a_revocation_outlives_a_crash_of_the_broker(kind: BrokerKind, tmp_path: Path) -> None:
    with start_broker(kind, tmp_path) as broker:
        revoked, kept = broker.issue(broker.grant("revoked")), broker.issue(broker.grant("kept"))
        broker.revoke(client_id="revoked")
        broker.kill()
    with start_broker(kind, tmp_path) as broker:
        with broker.connect("revoked", revoked) as client:
            assert not client.connected.is_set()
        with broker.connect("kept", kept) as client:
            assert client.connected.is_set()


def test_a_missing_password_file_is_an_error(tmp_path: Path) -> None:
    access = MosquittoBrokerAccess(host=HOST, port=1, username="service", password_file=tmp_path / "none")
    with pytest.raises(BrokerAccessError, match="start the broker"):
        access.service_credentials()


def test_a_token_of_another_key_is_rejected(tmp_path: Path) -> None:
    with start_broker("amqtt", tmp_path) as broker:
        grant = broker.grant("thief", publish=("#",))
        forged = TokenBrokerAccess(signer=signing.generate, publish=_nowhere)
        with broker.connect("thief", broker.run(forged.issue(grant))) as thief:
            assert not thief.connected.is_set()


async def _nowhere(_: str, __: bytes) -> None:
    raise AssertionError("unexpected publish")
