"""The command bus and the feeds of ``MemoryBroker``, which the unit tests of the services use."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Sequence

import pytest

from function_app.domain.common.problems import Problem
from function_app.ports.broker_access import BrokerAccessError, Credentials
from function_app.ports.tables import StoreError
from tests.contract.bus.suite import BusContract, Sent, Stage
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.fakes.broker_ports import MemoryBrokerAccess, MemoryCommandBus, MemoryFeed, MemoryTelemetry
from tests.harness.network.brokers import Message

SPACE = "ts/v1/space"
STATE = f"{SPACE}/agent/arm/state"

pytestmark = pytest.mark.anyio


class TestMemoryBus(BusContract):
    @pytest.fixture
    def stage(self) -> Stage:
        broker, unreachable = MemoryBroker(), MemoryBroker()
        unreachable.reachable = False
        received: list[Sent] = []

        class Listener:
            def matches(self, topic: str) -> bool:
                return topic.startswith(SPACE)

            def deliver(self, message: Message) -> None:
                received.append(Sent(message.topic, message.payload))

        broker.attach(Listener())

        def retained(topic: str) -> bytes | None:
            return next((message.payload for message in broker.retained(topic)), None)

        return Stage(MemoryCommandBus(broker), "space", lambda: received, retained, MemoryCommandBus(unreachable))


async def connect(broker: MemoryBroker, client_id: str = "viewer") -> MemoryConnection:
    grant = broker.grant(client_id, publish=(f"{SPACE}/+/+/ctl/+",), subscribe=(f"{SPACE}/#",))
    return MemoryConnection(broker, client_id, await MemoryBrokerAccess(broker).issue(grant)).open()


def accepts(broker: MemoryBroker, client_id: str, credentials: Credentials | None) -> bool:
    return MemoryConnection(broker, client_id, credentials).open().connected.is_set()


async def test_a_connection_has_only_the_permissions_of_its_grant() -> None:
    broker = MemoryBroker()
    viewer, other = await connect(broker), await connect(broker, "other")
    for payload in (b"old", b"new"):
        broker.publish(STATE, payload, retain=True)
    assert viewer.subscribe(f"{SPACE}/+/+/state", "ts/v1/elsewhere/#", "#") == [1, 128, 128]
    assert [(message.payload, message.retain) for message in viewer.pending()] == [(b"new", True)]
    other.subscribe(f"{SPACE}/+/+/ctl/+", f"{SPACE}/+/+/cmd")
    viewer.publish(f"{SPACE}/agent/arm/ctl/1", b"setpoint")
    viewer.publish(f"{SPACE}/agent/arm/cmd", b"forbidden")
    assert [message.payload for message in other.pending()] == [b"setpoint"]
    credentials = viewer._credentials
    for client_id, presented in (("x", credentials), ("viewer", None), ("viewer", Credentials("account:viewer", "?"))):
        assert not accepts(broker, client_id, presented)
    second = await connect(broker)
    assert (viewer.disconnected.is_set(), second.disconnected.is_set()) == (True, False)


@pytest.mark.parametrize("names", [{"client_id": "viewer"}, {"principal": "account:viewer"}, {"principal": "account"}])
async def test_a_revocation_ends_connections_and_credentials(names: dict[str, str]) -> None:
    broker = MemoryBroker()
    viewer = await connect(broker)
    viewer.will = Message(f"{SPACE}/agent/conn", b"offline", 1, retain=True)
    await MemoryBrokerAccess(broker).revoke(**names)
    assert viewer.disconnected.is_set()
    assert not accepts(broker, "viewer", viewer._credentials)
    assert [message.payload for message in broker.retained(f"{SPACE}/agent/conn")] == [b"offline"]
    assert (await connect(broker)).connected.is_set()


async def test_credentials_expire_by_the_clock_of_the_broker() -> None:
    now_s = [1000.0]
    broker = MemoryBroker(now_s=lambda: now_s[0])
    viewer = await connect(broker)
    for now_s[0], ended in ((1299.0, False), (1300.0, True)):
        await MemoryBrokerAccess(broker).expire(now_s[0])
        assert viewer.disconnected.is_set() == ended


async def test_an_unreachable_broker_and_an_invalid_revocation_are_errors() -> None:
    broker = MemoryBroker()
    for names in ({}, {"client_id": "a", "principal": "b"}):
        with pytest.raises(ValueError, match="exactly one"):
            await MemoryBrokerAccess(broker).revoke(**names)
    broker.reachable = False
    for call in (MemoryBrokerAccess(broker).revoke(client_id="viewer"), connect(broker)):
        with pytest.raises(BrokerAccessError):
            await call


class TestMemoryFeeds:
    async def test_messages_of_a_topic_are_stored_in_order_and_the_broker_is_idle_afterwards(self) -> None:
        broker, stored = MemoryBroker(), []

        async def handle(topic: str, payload: bytes) -> None:
            await asyncio.sleep(0)
            stored.append((topic, payload))

        broker.publish(STATE, b"retained", retain=True)
        async with running(MemoryFeed(broker).run(handle)):
            for payload in (b"1", b"2"):
                broker.publish(STATE, payload)
            broker.publish(f"{SPACE}/agent/arm/cmd", b"not for the cloud")
            await broker.idle()
        assert stored == [(STATE, payload) for payload in (b"retained", b"1", b"2")]

    async def test_a_message_that_cannot_be_stored_is_retried_and_then_dropped(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("tests.fakes.broker_ports.RETRY_S", 0)
        broker, tried = MemoryBroker(), []

        async def handle(_: str, payload: bytes) -> None:
            tried.append(payload)
            if payload == b"fails":
                raise ZeroDivisionError
            if payload == b"busy" or tried.count(payload) < 3:
                raise Problem("busy", 503, "Busy", "Try again.") if payload == b"busy" else StoreError("unreachable")

        async with running(MemoryFeed(broker).run(handle)):
            for payload in (b"busy", b"fails", b"valid"):
                broker.publish(STATE, payload)
            await broker.idle()
        assert tried == [*[b"busy"] * 6, b"fails", *[b"valid"] * 3]

    @pytest.mark.parametrize(("late", "kind"), [(False, "tele"), (True, "late")])
    async def test_measurements_arrive_in_batches(self, late: bool, kind: str) -> None:
        broker, batches = MemoryBroker(), []

        async def handle(batch: Sequence[tuple[str, bytes]]) -> None:
            batches.append([payload for _, payload in batch])

        async with running(MemoryTelemetry(broker, late=late).run(handle)):
            for name in ("tele", "late"):
                for number in range(3):
                    broker.publish(f"{SPACE}/agent/arm/{name}/joints", f"{name}{number}".encode())
            await broker.idle()
        assert [payload for batch in batches for payload in batch] == [f"{kind}{n}".encode() for n in range(3)]


@contextlib.asynccontextmanager
async def running(feed: Awaitable[None]) -> AsyncIterator[None]:
    task = asyncio.ensure_future(feed)
    await asyncio.sleep(0)
    yield
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
